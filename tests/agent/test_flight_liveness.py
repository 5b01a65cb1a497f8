"""Pilot and guard detect whether the other program runs."""

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

PILOT_PROGRAM = """\
import sys, time
from fieldkit.agent.flying.liveness import FLYING, PILOT, LivenessFile
file = LivenessFile(sys.argv[1], PILOT)
for count in range(10**9):
    if count < int(sys.argv[2]):
        file.update(FLYING)
    time.sleep(0.02)
"""


@contextmanager
def running_pilot(path: Path, n_updates: int) -> Iterator["subprocess.Popen[bytes]"]:
    process = subprocess.Popen((sys.executable, "-c", PILOT_PROGRAM, str(path), str(n_updates)))
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


def test_exit_suspension_and_hang_are_detected(tmp_path: Path) -> None:
    liveness_file = LivenessFile(str(tmp_path / "file"), GUARD)
    assert liveness_file.poll() == "has ended", "the pilot has not started"
    with running_pilot(tmp_path / "file", 10**9) as process:
        wait_until(lambda: liveness_file.poll() == "", Deadline.after(60))
        assert liveness_file.other_state == liveness.FLYING
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: liveness_file.poll() == "is suspended", Deadline.after(60))
        liveness_file.kill_other()
        assert process.wait(60) == -signal.SIGKILL
        assert liveness_file.poll() == "has ended"
    with running_pilot(tmp_path / "file", 5):
        wait_until(lambda: liveness_file.poll().startswith("has not run for"), Deadline.after(60))


def test_other_process_with_the_same_pid_is_not_killed(tmp_path: Path) -> None:
    """A pid is reused, but the start time differs."""
    guard = LivenessFile(str(tmp_path / "file"), GUARD)
    LivenessFile(str(tmp_path / "file"), PILOT).update(liveness.FLYING)
    raw = bytearray((tmp_path / "file").read_bytes())
    raw[8:16] = (1).to_bytes(8, "little")
    (tmp_path / "file").write_bytes(raw)
    assert guard.poll() == "has ended"
    guard.kill_other()  # the pid in the file is that of this process, which must survive


def test_file_that_cannot_be_created_prevents_the_flight() -> None:
    with pytest.raises(FileNotFoundError):
        LivenessFile("/nowhere/liveness", PILOT)
