"""`run.json` of a recording: what was run, with what, and how it ended."""

import fcntl
import hashlib
import json
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from fieldkit.config.schema import Codec
from fieldkit.core import files
from fieldkit.core.errors import EvidenceError

SCHEMA_VERSION: Final = 2
RUN_AGAIN: Final = "take a copy of the folder if there is one, or run the scenario in it again"
"""What helps where a recording is damaged."""
_NAME: Final = "run.json"
_CHECKSUM: Final = "content_hash"
"""Its key, beside those of `RunManifest`: SHA-256 of these."""


class RunEnding(StrEnum):
    """How a run ended."""

    UNDER_WAY = "under way"
    KILLED = "killed"
    """Who is killed says no more: `run.json` says that it is under way, and nobody writes it."""
    WHOLE = "whole"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class About:
    """What is run.

    Attributes:
        scenario: Text of the scenario.
        policy: Name of the sync policy.
        parameters: Its parameters, plain values.
        seed: Of all random draws.
    """

    scenario: str
    policy: str
    parameters: Mapping[str, Any]
    seed: int

    @property
    def scenario_hash(self) -> str:
        """SHA-256 of the scenario's text, in hexadecimal."""
        return hashlib.sha256(self.scenario.encode()).hexdigest()


@dataclass(frozen=True)
class RunManifest:
    """What `run.json` holds.

    Attributes:
        about: What is run.
        scenario_hash: SHA-256 of the scenario's text.
        schema_version: Of the recording.
        versions: Of fieldkit, Python and the libraries whose numbers a run depends on.
        ending: How it ended.
        why: Who failed and how, else empty.
        digest: Of all events (`EventDigest`), empty while it is under way.
        parts: BLAKE2b of each file of a table, by its path in the folder; empty while it is under way.
    """

    about: About
    scenario_hash: str
    schema_version: int = SCHEMA_VERSION
    versions: Mapping[str, str] = field(default_factory=dict)
    ending: RunEnding = RunEnding.UNDER_WAY
    why: str = ""
    digest: str = ""
    parts: Mapping[str, str] = field(default_factory=dict)


_CODEC: Final = Codec(RunManifest)


def versions() -> dict[str, str]:
    """Return the versions that `RunManifest.versions` is about, of what runs now."""
    return {"python": platform.python_version()} | {name: version(name) for name in ("fieldkit", "numpy")}


def write_manifest(folder: Path, manifest: RunManifest) -> None:
    """Write `run.json`; the one before stays where that fails.

    Raises:
        OSError: It cannot be written.
    """
    content = _CODEC.dump(manifest)
    content[_CHECKSUM] = _checksum(content)
    files.write(folder / _NAME, (json.dumps(content, indent=2) + "\n").encode())


@contextmanager
def being_written(folder: Path) -> Iterator[None]:
    """Let readers know for as long as it lasts that a recording is being written; its end may be that of the process.

    Raises:
        OSError: It cannot be locked.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _is_being_written(folder: Path) -> bool:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def read_manifest(folder: Path) -> RunManifest:
    """Read `run.json`; of one that says that it is under way, find out whether it is.

    Raises:
        EvidenceError: There is none, it is none, or it was changed.
    """
    found = _read(folder)
    if found.ending is RunEnding.UNDER_WAY and not _is_being_written(folder):
        found = _read(folder)  # it may have come to its end meanwhile
        if found.ending is RunEnding.UNDER_WAY:
            return replace(found, ending=RunEnding.KILLED)
    return found


def _read(folder: Path) -> RunManifest:
    path = folder / _NAME
    try:
        content = json.loads(path.read_bytes())
        checksum = content.pop(_CHECKSUM, None) if isinstance(content, dict) else None
        found = _CODEC.parse(content)
    except FileNotFoundError as error:
        raise EvidenceError(
            "there is no recording of a co-simulation", where=str(folder), remedy="name the folder that has run.json"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise EvidenceError(f"this is no record of a run: {error}", where=str(path), remedy=RUN_AGAIN) from error
    if found.schema_version != SCHEMA_VERSION:
        raise EvidenceError(
            f"the recording has schema version {found.schema_version}, this fieldkit reads {SCHEMA_VERSION}",
            where=str(path),
            remedy=f"read it with fieldkit {found.versions.get('fieldkit', '')}".rstrip(),
        )
    if found.scenario_hash != found.about.scenario_hash:
        raise EvidenceError(
            "the scenario's text is not the one that was run: its hash differs", where=str(path), remedy=RUN_AGAIN
        )
    if found.ending is RunEnding.WHOLE and not (found.digest and found.parts):
        raise EvidenceError(
            "a run that came to its end has a digest and parts, and this says none", where=str(path), remedy=RUN_AGAIN
        )
    if checksum != _checksum(content):
        raise EvidenceError(
            "the record was changed after the run: its hash differs", where=str(path), remedy=RUN_AGAIN
        )
    return found


def _checksum(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
