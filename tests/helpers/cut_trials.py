"""A trial on a disk with simulated power cuts, at each sync or repeatedly at random times."""

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
from fieldkit.trial.running.resumption import resume_trial
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.runner import run_trial
from tests.helpers.disks import Disk, FileSystem
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.power import PowerCut, VersionRecorder, assert_resumable
from tests.trial.test_trial_crash import VOID_FIRST, plan, robots_with_evidence

OUT: Final = "trials"
_FSYNC: Final = os.fsync


@contextmanager
def robots_with_much_evidence() -> Iterator[None]:
    """Simulate robots with evidence that could be lost in different ways.

    The evidence contains an empty folder, a file too large for an inode of the file system, and a file in a separate
    folder that is renamed after its sync.
    """
    with pytest.MonkeyPatch.context() as patch:
        robots_with_evidence(patch)
        original_fetch: Callable[..., list[str]] = Robots.fetch

        def fetch(robots: Robots, remote: str, folder: Path, **options: object) -> list[str]:
            reasons = original_fetch(robots, remote, folder, **options)
            if remote.endswith(VOID_FIRST):
                (folder / "ping.txt").unlink()
                return reasons
            (folder / "sender.pcap").write_bytes(hashlib.sha256(remote.encode()).digest() * 4000)
            temporary = folder / "scan" / ".part"
            temporary.parent.mkdir(exist_ok=True)
            with temporary.open("wb") as file:
                file.write(remote.encode())
                file.flush()
                _FSYNC(file.fileno())
            temporary.rename(temporary.with_name("metadata.yaml"))
            return reasons

        patch.setattr(Robots, "fetch", fetch)
        yield


def run(out: Path, recorder: VersionRecorder) -> None:
    """Start the trial in `out`, or resume it if its plan is on the disk; the recorder receives the events."""
    plans = list(out.glob(f"*/{PLAN_FILE}"))
    if plans:
        resume_trial(plans[0].parent, IdleTestbed(), recorder.on_event)
    else:
        out.mkdir(exist_ok=True)
        for leftover in out.iterdir():  # a trial that was not reported to the user; the next one has a different name
            shutil.rmtree(leftover)
        run_trial(plan(), IdleTestbed(), out, recorder.on_event)


@contextmanager
def at_every_sync(call: Callable[[str], bool]) -> Iterator[None]:
    """Call a function before each sync of a file or folder, with the source line in fieldkit that requests the sync.

    Syncs that are normally concurrent are serialized.

    Args:
        call: Called with the source line; it returns False to skip the sync.
    """
    lock = threading.Lock()

    def sync(descriptor: int) -> None:
        with lock:
            if call(_sync_location()):
                _FSYNC(descriptor)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        yield


def _sync_location() -> str:
    """The source line in fieldkit that requested the sync; for a folder, the line that calls `sync_folder`."""
    frames: list[FrameType] = []
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        if "fieldkit" in Path(frame.f_code.co_filename).parts[-3:]:
            frames.append(frame)
        frame = frame.f_back
    frame = next((caller for caller in frames if caller.f_code.co_name not in {"sync_folder", "_sync"}), frames[0])
    line = linecache.getline(frame.f_code.co_filename, frame.f_lineno).strip()
    return f"{Path(frame.f_code.co_filename).stem}.{frame.f_code.co_name}: {line}"


def cuts_at_every_sync(
    disk: Disk, place: Path, *, without: str = ""
) -> tuple[list[PowerCut], VersionRecorder, list[str]]:
    """Run the trial on a disk and record the disk as a power cut before each sync and at the end would leave it.

    Only synced data reaches the disk, so these are all states of the disk that a cut can leave. Each state is
    combined with all events that were reported to the user until then.

    Args:
        disk: The disk.
        place: A working folder.
        without: The source line whose sync is skipped; none if empty.

    Returns:
        The cuts, the recorder of the trial, and the source lines that requested a sync.
    """
    cuts: list[PowerCut] = []
    locations: list[str] = []
    with disk.mounted(place / "disk") as mounted:
        (out := mounted / OUT).mkdir()
        recorder = VersionRecorder(out)

        def cut(location: str) -> bool:
            recorder.record_versions()
            image = disk.image(mounted, place / f"cut-{len(cuts)}.img")
            cuts.append(
                PowerCut(image, dict(recorder.reported), recorder.is_over, f"cut {len(cuts)}, before {location}")
            )
            locations.append(location)
            return location != without

        with at_every_sync(cut):
            run(out, recorder)
        cut("power off")
    return cuts, recorder, locations[:-1]


@contextmanager
def at_call(number: int, action: Callable[[], None]) -> Iterator[None]:
    """Call a function after `number` function calls and returns in the body.

    The count measures the progress of a trial reproducibly, unlike time.
    """
    remaining_calls = number

    def count_call(*_: object) -> None:
        nonlocal remaining_calls
        remaining_calls -= 1
        if remaining_calls < 0:
            sys.setprofile(None)
            action()

    sys.setprofile(count_call)
    try:
        yield
    finally:
        sys.setprofile(None)


def calls_of_a_trial(place: Path) -> int:
    """Approximate number of calls and returns in a trial; the first trial of a process has more."""
    counts = []
    for number in range(2):
        recorder = VersionRecorder(place / f"whole-{number}")
        calls = itertools.count()
        sys.setprofile(lambda *_, calls=calls: next(calls))
        try:
            run(recorder.folder, recorder)
        finally:
            sys.setprofile(None)
        counts.append(next(calls))
    return min(counts)


def cut_after_calls(disk: Disk, place: Path, file: Path, after_calls: int) -> tuple[PowerCut, VersionRecorder]:
    """Run or resume the trial on a disk, and cut the power after a number of calls and returns or at the trial's end.

    The trial continues while the disk is copied, so the effective cut may be slightly later.

    Args:
        disk: The disk.
        place: A working folder.
        file: Path of the new disk image.
        after_calls: Number of calls and returns before the cut.
    """
    with disk.mounted(place / "disk") as mounted, ThreadPoolExecutor() as pool:
        (out := mounted / OUT).mkdir(exist_ok=True)
        recorder = VersionRecorder(out)
        recorder.record_versions()
        recorder.reported = dict.fromkeys(recorder.versions, 0)  # these versions are on disk and must stay there
        states: list[tuple[dict[str, int], bool]] = []
        cut_requested = threading.Event()

        def image() -> PowerCut:
            cut_requested.wait()
            ((reported, is_over),) = states
            return PowerCut(
                disk.image(mounted, file), reported, is_over, f"cut after {after_calls} calls and returns"
            )

        def cut() -> None:
            # The trial may hold any lock at this time, including one of the thread pool, so no thread is started.
            states.append((dict(recorder.reported), recorder.is_over))
            cut_requested.set()

        def record(_location: str) -> bool:
            recorder.record_versions()
            return True

        cut_result = pool.submit(image)
        try:
            with at_every_sync(record), at_call(after_calls, cut):
                run(out, recorder)
            recorder.record_versions()
        finally:
            if not states:
                cut()
        return cut_result.result(), recorder


def lose_power_repeatedly(file_system: FileSystem, place: Path, draw: random.Random, *, calls: int, most: int) -> int:
    """Run a trial with a power cut at a random time, and resume it with the remaining data until it is complete.

    Args:
        file_system: The file system of the disk.
        place: A working folder.
        draw: Random generator for the times of the cuts.
        calls: The result of `calls_of_a_trial`.
        most: Maximum number of cuts; the run after the last cut is completed.

    Returns:
        The number of cuts.

    Raises:
        AssertionError: Data was lost.
    """
    disk, image = Disk.make(file_system, place / "disk.img"), place / "left.img"
    for number in range(1, most + 1):
        cut, recorder = cut_after_calls(disk, place, image, draw.randrange(calls))
        image.rename(disk.file)
        with disk.repair().mounted(place / "disk") as mounted:
            problems = cut.lost_files(mounted / OUT, recorder)
            assert not problems, problems
            if cut.is_over or number == most:
                run(mounted / OUT, recorder)
                assert_resumable(mounted / OUT)
                break
    disk.file.unlink()
    return number
