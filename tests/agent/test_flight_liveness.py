"""Pilot and guard see of each other whether they run."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fieldkit.agent.flying import liveness
from fieldkit.agent.flying.liveness import GUARD, PILOT, LivenessFile
from fieldkit.core.deadline import Deadline
from tests.helpers.sshd import wait_until

BEATS = """\
import sys, time
from fieldkit.agent.flying.liveness import FLYING, PILOT, LivenessFile
file = LivenessFile(sys.argv[1], PILOT)
for count in range(10**9):
    if count < int(sys.argv[2]):
        file.beat(FLYING)
    time.sleep(0.02)
"""


@contextmanager
def pilot(path: Path, beats: int) -> Iterator["subprocess.Popen[bytes]"]:
    process = subprocess.Popen((sys.executable, "-c", BEATS, str(path), str(beats)))
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


def test_an_end_a_suspension_and_a_hang_are_seen(tmp_path: Path) -> None:
    own = LivenessFile(str(tmp_path / "file"), GUARD)
    assert own.poll() == "has ended", "it has not begun"
    with pilot(tmp_path / "file", 10**9) as process:
        wait_until(lambda: own.poll() == "", Deadline.after(60))
        assert own.other_state == liveness.FLYING
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: own.poll() == "is suspended", Deadline.after(60))
        own.kill_other()
        assert process.wait(60) == -signal.SIGKILL
        assert own.poll() == "has ended"
    with pilot(tmp_path / "file", 5):
        wait_until(lambda: own.poll().startswith("has not run for"), Deadline.after(60))


def test_another_process_with_its_number_is_not_ended(tmp_path: Path) -> None:
    """A number is given again later; the time of the start is not."""
    guard = LivenessFile(str(tmp_path / "file"), GUARD)
    LivenessFile(str(tmp_path / "file"), PILOT).update(liveness.FLYING)
    raw = bytearray((tmp_path / "file").read_bytes())
    raw[8:16] = (1).to_bytes(8, "little")
    (tmp_path / "file").write_bytes(raw)
    assert guard.poll() == "has ended"
    guard.kill_other()
    assert os.getpid()


def test_without_room_there_is_no_flight() -> None:
    with pytest.raises(FileNotFoundError):
        LivenessFile("/nowhere/liveness", PILOT)
