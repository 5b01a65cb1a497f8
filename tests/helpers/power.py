"""What a user was told of a trial before a power cut, and whether the disk that the cut left still has it."""

import hashlib
import linecache
import os
import random
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final

import pytest

from fieldkit.config import schema
from fieldkit.core.errors import EvidenceError
from fieldkit.core.events import Event, Note, RepeatEnded, TrialEnded
from fieldkit.core.model import Status
from fieldkit.trial import journal
from fieldkit.trial.hashes import code_hash
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE, Plan
from fieldkit.trial.robots import Robots
from fieldkit.trial.runner import resume_trial, run_trial
from tests.helpers.disks import Disk, FileSystem
from tests.helpers.idle_testbed import IdleTestbed
from tests.trial.test_trial_crash import VOID_FIRST, demand_whole, plan, robots_with_evidence, trial_of

OUT: Final = "trials"
MOMENTS_S: Final = 0.1
"""How long the trial takes here, about."""

_MANIFEST: Final = "MANIFEST.sha256"
_FSYNC: Final = os.fsync


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


@contextmanager
def robots_with_much_evidence() -> Iterator[None]:
    """Let robots have measured, without robots, and leave what brings its own ways to get lost.

    A folder with nothing in it, a file that is too large for a node of the file system, and one in a folder of its
    own that got its name when it had been synced.
    """
    with pytest.MonkeyPatch.context() as patch:
        robots_with_evidence(patch)
        small: Callable[..., list[str]] = Robots.fetch

        def fetch(robots: Robots, remote: str, into: Path, **more: object) -> list[str]:
            reasons = small(robots, remote, into, **more)
            if remote.endswith(VOID_FIRST):
                (into / "ping.txt").unlink()
                return reasons
            (into / "sender.pcap").write_bytes(hashlib.sha256(remote.encode()).digest() * 4000)
            part = into / "scan" / ".part"
            part.parent.mkdir(exist_ok=True)
            with part.open("wb") as file:
                file.write(remote.encode())
                file.flush()
                _FSYNC(file.fileno())
            part.rename(part.with_name("metadata.yaml"))
            return reasons

        patch.setattr(Robots, "fetch", fetch)
        # Most of a short resumption is reading of the same YAML and the same code.
        patch.setattr(schema, "load", _once(schema.load))
        patch.setattr("fieldkit.trial.resumption.code_hash", cache(code_hash))
        yield


def _once(load: Callable[[Path, type[Plan]], Plan]) -> Callable[[Path, type[Plan]], Plan]:
    """Read files of equal content once."""
    known: dict[bytes, Plan] = {}

    def loaded(path: Path, kind: type[Plan]) -> Plan:
        content = path.read_bytes()
        if content not in known:
            known[content] = load(path, kind)
        return known[content]

    return loaded


def run(out: Path, witness: Witness) -> None:
    """Begin the trial in `out`, or go on with it where a cut left its plan; a witness hears what the user is told."""
    begun = list(out.glob(f"*/{PLAN_FILE}"))
    if begun:
        resume_trial(begun[0].parent, IdleTestbed(), witness.hear)
    else:
        out.mkdir(exist_ok=True)
        for nothing in out.iterdir():  # of a trial that nobody was told of; the next has a name of its own
            shutil.rmtree(nothing)
        run_trial(plan(), IdleTestbed(), out, witness.hear)


@contextmanager
def at_every_sync(call: Callable[[str], bool]) -> Iterator[None]:
    """Call something before each sync of a file or folder, with the place in fieldkit that asks for it.

    Args:
        call: Returns whether to sync at all.
    """

    def sync(descriptor: int) -> None:
        if call(_place()):
            _FSYNC(descriptor)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        yield


def _place() -> str:
    """Return which line of fieldkit syncs: the one that calls `sync_folder` for a folder."""
    frame = sys._getframe(2)
    while "fieldkit" not in Path(frame.f_code.co_filename).parts[-3:] or frame.f_code.co_name == "sync_folder":
        assert frame.f_back is not None
        frame = frame.f_back
    line = linecache.getline(frame.f_code.co_filename, frame.f_lineno).strip()
    return f"{Path(frame.f_code.co_filename).stem}.{frame.f_code.co_name}: {line}"


def cuts_at_every_sync(disk: Disk, place: Path, *, without: str = "") -> tuple[list[Cut], Witness, list[str]]:
    """Run the trial on a disk and cut its power before each sync and at the end, when more has not reached it.

    Between two syncs nothing reaches the disk, so these are all the disks that cuts there can leave, each with the
    most that the user was told meanwhile.

    Args:
        disk: The disk.
        place: Folder to work in.
        without: A place in fieldkit whose sync is taken out.

    Returns:
        The cuts, who saw the trial, and the places that asked for a sync.
    """
    cuts: list[Cut] = []
    places: list[str] = []
    with disk.mounted(place / "disk") as mounted:
        (out := mounted / OUT).mkdir()
        witness = Witness(out)

        def cut(at: str) -> bool:
            witness.look()
            image = disk.image(mounted, place / f"cut-{len(cuts)}.img")
            cuts.append(Cut(image, dict(witness.told), witness.is_over, f"cut {len(cuts)}, before {at}"))
            places.append(at)
            return at != without

        with at_every_sync(cut):
            run(out, witness)
        cut("power off")
    return cuts, witness, places[:-1]


def cut_at_a_moment(disk: Disk, place: Path, file: Path, after_s: float) -> tuple[Cut, Witness]:
    """Run the trial on a disk, or go on with it, and cut the power so long after it began.

    Args:
        disk: The disk.
        place: Folder to work in.
        file: Gets what the cut leaves.
        after_s: When, in seconds.
    """
    with disk.mounted(place / "disk") as mounted:
        (out := mounted / OUT).mkdir(exist_ok=True)
        witness = Witness(out)
        witness.look()
        witness.told = dict.fromkeys(witness.versions, 0)  # what a cut has left is on disk, and must stay there
        cuts: list[Cut] = []

        def cut() -> None:
            told, is_over = dict(witness.told), witness.is_over
            cuts.append(Cut(disk.image(mounted, file), told, is_over, f"cut after {after_s * 1e3:.0f} ms"))

        def look(_place: str) -> bool:
            witness.look()
            return True

        timer = threading.Timer(after_s, cut)
        timer.start()
        with at_every_sync(look):
            run(out, witness)
        witness.look()
        timer.join()
    return cuts[0], witness


def cuts_in_a_row(file_system: FileSystem, place: Path, draw: random.Random, most: int) -> int:
    """Run a trial whose power is cut at a random moment, go on with what that left, and so on; it ends whole.

    Args:
        file_system: Of its disk.
        place: Folder to work in.
        draw: Says when to cut.
        most: How often to cut at most; then the trial runs to its end.

    Returns:
        How often it was cut.

    Raises:
        AssertionError: Something is lost.
    """
    disk, left = Disk.make(file_system, place / "disk.img"), place / "left.img"
    for number in range(1, most + 1):
        cut, witness = cut_at_a_moment(disk, place, left, draw.uniform(0, MOMENTS_S))
        left.rename(disk.file)
        with disk.mend().mounted(place / "disk") as mounted:
            lost = cut.lost(mounted / OUT, witness)
            assert not lost, lost
            if cut.is_over or number == most:
                run(mounted / OUT, witness)
                demand_resumable(mounted / OUT)
                break
    disk.file.unlink()
    return number
