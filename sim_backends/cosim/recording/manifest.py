"""`run.json` of a recording: what was run, with what, and how it ended."""

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from fieldkit.config.schema import Codec
from fieldkit.core import files
from fieldkit.core.errors import EvidenceError

SCHEMA_VERSION: Final = 1
RUN_AGAIN: Final = "take a copy of the folder if there is one, or run the scenario in it again"
"""What helps where a recording is damaged."""
_NAME: Final = "run.json"


class RunEnding(StrEnum):
    """How a run ended."""

    UNDER_WAY = "under way"
    """It goes on, or was killed: who is killed says no more."""
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
    files.write(folder / _NAME, (json.dumps(_CODEC.dump(manifest), indent=2) + "\n").encode())


def read_manifest(folder: Path) -> RunManifest:
    """Read `run.json`.

    Raises:
        EvidenceError: There is none, or it is none.
    """
    path = folder / _NAME
    try:
        found = _CODEC.parse(json.loads(path.read_bytes()))
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
    return found
