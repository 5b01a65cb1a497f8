"""The rescue of a drone from the laptop: the loss of pilot and guard is detected, and the rescue starts."""

import struct
import threading
from collections.abc import Sequence
from typing import cast

import pytest

from fieldkit.agent.flying.liveness import ENDED, FLYING, IDLE, LANDING
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError
from fieldkit.motion.steps.flight_rescue import MANUAL_ACTION, FlightRescue, LivenessMonitor
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Completed, Shell
from tests.helpers.sshd import wait_until

RESCUE = Job(folder="f", name="rescue", argv=("agent",), limit_s=60.0, log="rescue.log")


def sample(at_s: float, pilot: tuple[int, int], guard: tuple[int, int]) -> bytes:
    """Return the answer of a robot with the counter and state of the pilot and of the guard."""
    return struct.pack("<8Q", 11, 1, *pilot, 12, 1, *guard) + f"{at_s:.2f} 9.99\n".encode()


def losses(samples: Sequence[bytes]) -> list[bool]:
    """Return a list that is True for samples after which the loss of both programs is detected."""
    monitor = LivenessMonitor()
    return [monitor.update(sample) for sample in samples]


@pytest.mark.parametrize("states", [(FLYING, IDLE), (LANDING, IDLE), (FLYING, LANDING), (ENDED, LANDING)])
def test_loss_of_both_programs_is_detected_within_a_second(states: tuple[int, int]) -> None:
    pilot, guard = states
    running_samples = [sample(100 + 0.25 * count, (count, pilot), (count, guard)) for count in range(4)]
    silent_samples = [sample(101 + 0.25 * count, (3, pilot), (3, guard)) for count in range(3)]
    assert losses([*running_samples, *silent_samples]) == [False] * 6 + [True], (
        "0.75 s after the last change of a counter"
    )


def test_no_loss_while_one_program_runs() -> None:
    for pilot, guard in ((1, 0), (0, 1)):
        samples = [sample(100 + 0.25 * n, (7 + pilot * n, FLYING), (7 + guard * n, IDLE)) for n in range(20)]
        assert not any(losses(samples))


@pytest.mark.parametrize("states", [(IDLE, IDLE), (ENDED, IDLE), (ENDED, ENDED)])
def test_no_loss_without_a_flight(states: tuple[int, int]) -> None:
    pilot, guard = states
    assert not any(losses([sample(100 + n, (7, pilot), (7, guard)) for n in range(20)]))


def test_no_loss_after_suspension_or_invalid_answer() -> None:
    before, after = sample(100.0, (7, FLYING), (7, IDLE)), sample(4000.0, (7, FLYING), (7, IDLE))
    assert losses([before, after, b"", b"x" * 64, after[:70], sample(4000.2, (8, FLYING), (7, IDLE))]) == [False] * 6


class Robot:
    """The shell of a robot that starts jobs, and whose pilot and guard do not run."""

    robot = "copter"

    def __init__(self, *, can_start: bool = True) -> None:
        self.calls: list[str] = []
        self._can_start = can_start
        self._queries = 0

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        verb = argv[2]
        self.calls.append(verb)
        if verb == "life_signs":
            assert argv[3] == "f/.jobs/guard/liveness"
            self._queries += 1
            if self._queries == 2:
                raise LinkError("out of range", where=self.robot, remedy="")
            return Completed(tuple(argv), 0, sample(100 + 0.3 * self._queries, (7, FLYING), (7, IDLE)), b"")
        if not self._can_start:
            raise LinkError("out of range", where=self.robot, remedy="")
        return Completed(tuple(argv), 0, b"", b"")


def rescue(robot: Robot, alarms: list[str], *, may_send: bool = True) -> FlightRescue:
    return FlightRescue(cast("Shell", robot), RESCUE, ".jobs/guard/liveness", alarms.append, may_send=may_send)


def test_rescue_starts_once_with_an_alarm() -> None:
    robot, alarms = Robot(), list[str]()
    with rescue(robot, alarms) as monitor:
        wait_until(lambda: bool(alarms) and "start" in robot.calls, Deadline.after(60))
        assert monitor.may_land
    assert robot.calls.count("start") == 1
    assert robot.calls[-1] == "start"
    (alarm,) = alarms
    assert alarm.startswith("ALARM: THE PILOT AND THE GUARD OF copter DO NOT RUN. FIELDKIT LANDS IT.")
    assert alarm.endswith(MANUAL_ACTION)


def test_blocked_alarm_does_not_delay_the_rescue() -> None:
    robot, is_released = Robot(), threading.Event()

    def block(_text: str) -> None:
        is_released.wait(60)

    with FlightRescue(cast("Shell", robot), RESCUE, ".jobs/guard/liveness", block, may_send=True):
        wait_until(lambda: "start" in robot.calls, Deadline.after(60))
        is_released.set()


def test_failed_start_of_rescue_is_in_the_alarm() -> None:
    alarms = list[str]()
    with rescue(Robot(can_start=False), alarms) as monitor:
        wait_until(lambda: len(alarms) == 2, Deadline.after(60))
    assert not monitor.may_land
    assert f"ALARM: THE RESCUE OF copter DID NOT START: out of range. {MANUAL_ACTION}" in alarms


def test_nothing_is_sent_over_the_radio_under_test() -> None:
    robot = Robot()
    with rescue(robot, [], may_send=False) as monitor:
        assert "rescue" not in {thread.name for thread in threading.enumerate()}
    assert not monitor.may_land
    assert robot.calls == []
