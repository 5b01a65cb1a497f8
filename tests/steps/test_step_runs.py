"""Exit codes of the programs of steps: which are measurements, and which make the attempt fail."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Cast, Robot
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.ros.steps.record import RecordStep
from fieldkit.steps.kinds.capture import CaptureStep
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.scene import RecordedFile, Scene
from fieldkit.trial.procedure import load_procedure
from tests.helpers.casts import CAST, TURTLEBOT, ros_of
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.plans import steps_of
from tests.helpers.userlands import LocalShell

LOS = load_procedure("los")
ROS2 = TURTLEBOT.model_copy(update={"ros": ros_of(TURTLEBOT).model_copy(update={"variant": "ros2"})})
OF_ROS2: Cast = {Role.SENDER: Robot(name="turtlebot-1", address="10.42.0.1", profile=ROS2)}


@pytest.fixture
def testbed(tmp_path: Path) -> IdleTestbed:
    return IdleTestbed({role: LocalShell(tmp_path) for role in (Role.SENDER, Role.RECEIVER)})


def scene(cast: Cast = CAST) -> Scene:
    return Scene(Protocol.TCP, cast, "folder", {Role.SENDER: (RecordedFile(Role.SENDER, "scan.bag", 1e5),)})


def ignore(name: str, expected_s: float | None) -> None:
    """Ignore a phase."""


def set_exit_code(monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    """Replace `jobs.run`, so that every job ends with this exit code."""
    monkeypatch.setattr(jobs, "run", lambda shell, job: code)


@pytest.mark.parametrize("code", [0, 1])
def test_missing_replies_are_a_measurement(testbed: IdleTestbed, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    set_exit_code(monkeypatch, code)
    (ping,) = steps_of(LOS, PingStep)
    ping.run(scene(), testbed, ignore)


def test_ping_that_cannot_send_is_an_error(testbed: IdleTestbed, monkeypatch: pytest.MonkeyPatch) -> None:
    set_exit_code(monkeypatch, 2)
    (ping,) = steps_of(LOS, PingStep)
    with pytest.raises(RobotError, match="turtlebot-1: ping ended with exit code 2"):
        ping.run(scene(), testbed, ignore)


def test_exit_code_counts_only_for_recorder_with_duration(
    testbed: IdleTestbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_exit_code(monkeypatch, 1)
    (record,) = steps_of(LOS, RecordStep)
    with pytest.raises(RobotError, match="turtlebot-1: recording ended with exit code 1"):
        record.run(scene(), testbed, ignore)
    set_exit_code(monkeypatch, 2)
    record.run(scene(OF_ROS2), testbed, ignore)


def replace_captures(monkeypatch: pytest.MonkeyPatch, code: int) -> list[str]:
    """Replace the start and the stop of jobs, with this exit code; return the list of their calls."""
    calls: list[str] = []

    def start(shell: Shell, job: Job) -> None:
        calls.append(f"start {job.log}")

    def stop(shell: Shell, job: Job, **options: object) -> int:
        calls.append(f"stop {job.log}")
        return code

    monkeypatch.setattr(jobs, "start", start)
    monkeypatch.setattr(jobs, "stop", stop)
    return calls


def on_both(verb: str) -> Sequence[str]:
    return [f"{verb} receiver-capture.log", f"{verb} sender-capture.log"]


def test_failed_capture_is_an_error(testbed: IdleTestbed, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = replace_captures(monkeypatch, 1)
    set_exit_code(monkeypatch, 0)
    (capture,) = steps_of(LOS, CaptureStep)
    pings = [entry for entry in capture.during if entry.kind == "ping"]
    with pytest.raises(RobotError, match="turtlebot-1: tcpdump ended with exit code 1"):
        capture.model_copy(update={"during": pings}).run(scene(), testbed, ignore)
    assert sorted(calls[:2]) == on_both("start")
    assert sorted(calls[2:]) == on_both("stop")


def test_captures_are_stopped_after_error_inside(testbed: IdleTestbed, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = replace_captures(monkeypatch, 0)
    set_exit_code(monkeypatch, 2)
    (capture,) = steps_of(LOS, CaptureStep)
    pings = [entry for entry in capture.during if entry.kind == "ping"]
    with pytest.raises(RobotError, match="ping ended with exit code 2"):
        capture.model_copy(update={"during": pings}).run(scene(), testbed, ignore)
    assert sorted(calls[2:]) == on_both("stop")
