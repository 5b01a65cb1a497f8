"""The file `run.json` of a recording: the scenario, its settings, the software versions, and the end of the run."""

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

from fieldkit.config.json_records import Codec
from fieldkit.core import files
from fieldkit.core.errors import EvidenceError, shell_command

SCHEMA_VERSION: Final = 2
RUN_AGAIN: Final = "use a copy of the folder if there is one, or run the scenario again with another --out"
"""The remedy for a damaged recording."""
_NAME: Final = "run.json"
_CHECKSUM: Final = "content_hash"
"""Key of the SHA-256 over the other keys, which are the fields of `RunManifest`."""


class RunEnding(StrEnum):
    """The status of a run: under way, or the way in which it ended."""

    UNDER_WAY = "under way"
    KILLED = "killed"
    """`run.json` contains `under way`, but no process holds the lock; this value is never written."""
    COMPLETE = "whole"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class RunSettings:
    """The scenario and the settings of a run.

    Attributes:
        scenario: Text of the scenario.
        policy: Name of the sync policy.
        parameters: Parameters of the policy, plain values.
        seed: Seed of all random draws.
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
    """The content of `run.json`.

    Attributes:
        about: The scenario and its settings.
        scenario_hash: SHA-256 of the scenario's text.
        schema_version: Schema version of the recording.
        versions: Versions of fieldkit, Python and the libraries that affect the numbers of a run.
        ending: Status of the run.
        why: The error that ended the run; empty without an error.
        digest: Hash over all events (`EventDigest`); empty during the run.
        parts: BLAKE2b (128 bits, in hexadecimal) of each file of a table, by its path in the folder; empty during the
            run.
    """

    about: RunSettings
    scenario_hash: str
    schema_version: int = SCHEMA_VERSION
    versions: Mapping[str, str] = field(default_factory=dict)
    ending: RunEnding = RunEnding.UNDER_WAY
    why: str = ""
    digest: str = ""
    parts: Mapping[str, str] = field(default_factory=dict)


_CODEC: Final = Codec(RunManifest)


def software_versions() -> dict[str, str]:
    """Return the versions of the running software for `RunManifest.versions`."""
    return {"python": platform.python_version()} | {name: version(name) for name in ("fieldkit", "numpy")}


def write_manifest(folder: Path, manifest: RunManifest) -> None:
    """Write `run.json`; if this fails, the previous file remains.

    Raises:
        OSError: The file cannot be written.
    """
    content = _CODEC.dump(manifest)
    content[_CHECKSUM] = _checksum(content)
    files.write(folder / _NAME, (json.dumps(content, indent=2) + "\n").encode())


@contextmanager
def recording_lock(folder: Path) -> Iterator[None]:
    """Hold the lock that marks a recording as being written; the kernel releases it if the process is killed.

    Raises:
        OSError: The folder cannot be locked.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _is_locked(folder: Path) -> bool:
    """Return True if a process holds the lock of a recording, so that its run is under way."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def read_manifest(folder: Path) -> RunManifest:
    """Read `run.json`; the ending is `KILLED` if it contains `under way` but no process holds the lock.

    Raises:
        EvidenceError: The file does not exist, is invalid, was changed, or has another schema version.
    """
    manifest = _read_file(folder)
    if manifest.ending is RunEnding.UNDER_WAY and not _is_locked(folder):
        manifest = _read_file(folder)  # the run may have ended since the first read
        if manifest.ending is RunEnding.UNDER_WAY:
            return replace(manifest, ending=RunEnding.KILLED)
    return manifest


def _read_file(folder: Path) -> RunManifest:
    """Read and check `run.json`, with the ending that it contains."""
    path = folder / _NAME
    try:
        content = json.loads(path.read_bytes())
        checksum = content.pop(_CHECKSUM, None) if isinstance(content, dict) else None
        manifest = _CODEC.parse(content)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise EvidenceError(
            "there is no recording of a co-simulation",
            where=str(folder),
            remedy="give the folder that contains run.json",
        ) from error
    except OSError as error:
        remedy = f"check its permissions: {shell_command('ls', '-l', path)}"
        raise EvidenceError(f"cannot be read: {error.strerror}", where=str(path), remedy=remedy) from error
    except (ValueError, RecursionError) as error:
        raise EvidenceError(f"this is not the record of a run: {error}", where=str(path), remedy=RUN_AGAIN) from error
    if manifest.schema_version != SCHEMA_VERSION:
        raise EvidenceError(
            f"the recording has schema version {manifest.schema_version}, this fieldkit reads {SCHEMA_VERSION}",
            where=str(path),
            remedy=f"read it with fieldkit {manifest.versions.get('fieldkit', '')}".rstrip(),
        )
    if manifest.scenario_hash != manifest.about.scenario_hash:
        raise EvidenceError(
            "the scenario's text was changed after the run: its hash differs", where=str(path), remedy=RUN_AGAIN
        )
    if manifest.ending is RunEnding.COMPLETE and not (manifest.digest and manifest.parts):
        raise EvidenceError(
            "the run is complete, but the record has no digest or no parts", where=str(path), remedy=RUN_AGAIN
        )
    if checksum != _checksum(content):
        raise EvidenceError(
            "the record was changed after the run: its hash differs", where=str(path), remedy=RUN_AGAIN
        )
    return manifest


def _checksum(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
