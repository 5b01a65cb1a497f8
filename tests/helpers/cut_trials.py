"""A trial on a disk whose power is cut: at each sync, or at random moments, one cut after the other."""

import hashlib
import itertools
import linecache
import os
import random
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Final

import pytest

from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.runner import resume_trial, run_trial
from tests.helpers.disks import Disk, FileSystem
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.power import Cut, Witness, demand_resumable
from tests.trial.test_trial_crash import VOID_FIRST, plan, robots_with_evidence

OUT: Final = "trials"
_FSYNC: Final = os.fsync


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
        yield


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

    What is synced side by side is synced one after the other here.

    Args:
        call: Returns whether to sync at all.
    """
    alone = threading.Lock()

    def sync(descriptor: int) -> None:
        with alone:
            if call(_place()):
                _FSYNC(descriptor)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        yield


def _place() -> str:
    """Return which line of fieldkit syncs: for a folder the one that calls `sync_folder`."""
    frames: list[FrameType] = []
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        if "fieldkit" in Path(frame.f_code.co_filename).parts[-3:]:
            frames.append(frame)
        frame = frame.f_back
    frame = next((one for one in frames if one.f_code.co_name not in {"sync_folder", "_sync"}), frames[0])
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


@contextmanager
def at_call(number: int, then: Callable[[], None]) -> Iterator[None]:
    """Call something when the body has made so many calls of functions and returns from them.

    They tell how far a trial is, as a clock would on a machine that does nothing else.
    """
    left = number

    def see(*_: object) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            sys.setprofile(None)
            then()

    sys.setprofile(see)
    try:
        yield
    finally:
        sys.setprofile(None)


def calls_of_a_trial(place: Path) -> int:
    """Return how many calls and returns a trial makes, about; the first in a process makes more."""
    counts = []
    for number in range(2):
        witness = Witness(place / f"whole-{number}")
        calls = itertools.count()
        sys.setprofile(lambda *_, calls=calls: next(calls))
        try:
            run(witness.folder, witness)
        finally:
            sys.setprofile(None)
        counts.append(next(calls))
    return min(counts)


def cut_at_a_moment(disk: Disk, place: Path, file: Path, after_calls: int) -> tuple[Cut, Witness]:
    """Run the trial on a disk, or go on with it, and cut the power after so many calls and returns, or at its end.

    The trial runs on while the disk is copied, so the power goes then or a little later.

    Args:
        disk: The disk.
        place: Folder to work in.
        file: Gets what the cut leaves.
        after_calls: When.
    """
    with disk.mounted(place / "disk") as mounted, ThreadPoolExecutor() as pool:
        (out := mounted / OUT).mkdir(exist_ok=True)
        witness = Witness(out)
        witness.look()
        witness.told = dict.fromkeys(witness.versions, 0)  # what a cut has left is on disk, and must stay there
        moments: list[tuple[dict[str, int], bool]] = []
        asked = threading.Event()

        def image() -> Cut:
            asked.wait()
            ((told, is_over),) = moments
            return Cut(disk.image(mounted, file), told, is_over, f"cut after {after_calls} calls and returns")

        def cut() -> None:
            # The trial may be in any call, also in one that holds a lock of thread pools: start no thread here.
            moments.append((dict(witness.told), witness.is_over))
            asked.set()

        def look(_place: str) -> bool:
            witness.look()
            return True

        made = pool.submit(image)
        try:
            with at_every_sync(look), at_call(after_calls, cut):
                run(out, witness)
            witness.look()
        finally:
            if not moments:
                cut()
        return made.result(), witness


def cuts_in_a_row(file_system: FileSystem, place: Path, draw: random.Random, *, calls: int, most: int) -> int:
    """Run a trial whose power is cut at a random moment, go on with what that left, and so on; it ends whole.

    Args:
        file_system: Of its disk.
        place: Folder to work in.
        draw: Says when to cut.
        calls: From `calls_of_a_trial`.
        most: How often to cut at most; then the trial runs to its end.

    Returns:
        How often it was cut.

    Raises:
        AssertionError: Something is lost.
    """
    disk, left = Disk.make(file_system, place / "disk.img"), place / "left.img"
    for number in range(1, most + 1):
        cut, witness = cut_at_a_moment(disk, place, left, draw.randrange(calls))
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
