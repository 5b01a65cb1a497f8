"""What a user was told of a trial before a power cut, and whether the disk that the cut left still has it."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.core.events import Event, Note, RepeatEnded, TrialEnded
from fieldkit.core.model import Status
from fieldkit.trial import journal
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.running.runner import resume_trial
from tests.helpers.disks import Disk
from tests.helpers.idle_testbed import IdleTestbed
from tests.trial.test_trial_crash import VOID_FIRST, demand_whole, trial_of

_MANIFEST: Final = "MANIFEST.sha256"


@dataclass
class Witness:
    """Sees each version of each file that has its final name, and remembers which stood there when the user was told.

    Args:
        folder: Where trials go; must be there when it begins to look.
    """

    folder: Path
    versions: dict[str, list[bytes]] = field(default_factory=dict)
    told: dict[str, int] = field(default_factory=dict)
    is_over: bool = False

    def look(self) -> None:
        """Take in what is there now."""
        for name, content in visible(self.folder).items():
            seen = self.versions.setdefault(name, [])
            if not seen or seen[-1] != content:
                seen.append(content)

    def hear(self, event: Event) -> None:
        """Remember what stands there where an event tells the user that something is done."""
        if isinstance(event, Note | RepeatEnded | TrialEnded):
            self.look()
            self.told |= {name: len(seen) - 1 for name, seen in self.versions.items()}
            self.is_over = isinstance(event, TrialEnded)


@dataclass(frozen=True)
class Cut:
    """A power cut.

    Attributes:
        disk: What it left.
        told: What the user had been told by then: for each file, which version stood there.
        is_over: Whether the user had been told that the trial ended.
        at: Which moment of the trial it was.
    """

    disk: Disk
    told: dict[str, int]
    is_over: bool
    at: str

    def lost(self, folder: Path, witness: Witness) -> list[str]:
        """Return what is lost or half there in what the cut left, in sentences.

        Args:
            folder: Where trials went, on the disk that the cut left, mended and mounted.
            witness: Saw the trial that was cut.
        """
        left = visible(folder)
        lost = [
            f"{self.at}: {name} is {'not as told' if name in left else 'gone'}"
            for name, number in self.told.items()
            if not _is_since(left.get(name), witness.versions[name][number:], grows=name.endswith(JOURNAL_FILE))
        ]
        lost += [
            f"{self.at}: {name} is half there"
            for name, content in left.items()
            if not name.endswith(JOURNAL_FILE) and content not in witness.versions.get(name, [])
        ]
        return lost + [f"{self.at}: {problem}" for problem in _unkept(folder, witness)]


def everything(folder: Path) -> dict[str, bytes | None]:
    """Return the content of each file below a folder, and None for each folder."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    return {name: path.read_bytes() if path.is_file() else None for name, path in found.items()}


def visible(folder: Path) -> dict[str, bytes]:
    """Return the content of each file below a folder that has its final name."""
    found = everything(folder).items()
    return {name: content for name, content in found if "/." not in f"/{name}" and content is not None}


def _is_since(content: bytes | None, versions: list[bytes], *, grows: bool) -> bool:
    """Return whether a file is one of the versions from the one that was told; a journal only grows from that one."""
    if content is None:
        return False
    told = versions[0]
    return content.startswith(told[: told.rfind(b"\n") + 1]) if grows else content in versions


def _unkept(folder: Path, witness: Witness) -> Iterator[str]:
    """Yield what the journal or the manifest tell that is not there: evidence of attempts that ended."""
    left = visible(folder)
    for path in folder.glob(f"*/{JOURNAL_FILE}"):
        try:
            ended = journal.ended(journal.read(path.parent))
        except EvidenceError as error:
            yield error.what
            continue
        for attempt in ended:
            kept = path.parent / "repeats" / attempt.folder
            prefix = f"{kept.relative_to(folder).as_posix()}/"
            seen = {name: content[-1] for name, content in witness.versions.items() if name.startswith(prefix)}
            if not kept.is_dir() or seen != {name: left[name] for name in left if name.startswith(prefix)}:
                yield f"the evidence of {attempt.folder} is not what its journal line tells of"
    for manifest in [name for name in left if name.endswith(f"/{_MANIFEST}")]:
        for digest, name in (line.split("  ", 1) for line in left[manifest].decode().splitlines()):
            content = left.get(manifest.replace(_MANIFEST, name))
            if name.startswith("repeats/") and (content is None or hashlib.sha256(content).hexdigest() != digest):
                yield f"{name} is not what the manifest tells of"


def demand_resumable(out: Path) -> None:
    """Go on with a trial after a cut, and demand that it ends whole with every attempt that was over or measured."""
    folder = trial_of(out)
    entries = journal.read(folder) if (folder / JOURNAL_FILE).is_file() else []
    before, evidence = journal.ended(entries), visible(folder / "repeats")
    measured = [one for one in journal.cut_short(entries) if one.status is Status.MEASURED]
    resume_trial(folder, IdleTestbed(), lambda _: None)
    demand_whole(out)
    after = journal.ended(journal.read(folder))
    assert after[: len(before)] == before
    assert evidence.items() <= visible(folder / "repeats").items()
    is_valid = {(one.repeat, one.number): one.status is Status.VALID for one in after}
    for one in measured:
        assert is_valid[one.repeat, one.number] == (not VOID_FIRST.endswith(f"{one.repeat}-{one.number}")), one
