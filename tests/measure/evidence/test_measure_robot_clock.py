"""Clock steps between two readings are detected; slewing and slow readings are not steps."""

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.evidence import clock
from fieldkit.measure.evidence.clock import Clock

# Outputs of dash with coreutils, and of busybox with its adjtimex, on the same machine.
COREUTILS = """\
12610.46 1795320483.268162430 12610.47
12610.47 1795320483.269366458 12610.47
12610.47 1795320483.275125792 12610.47
12610.47 1795320483.278479484 12610.48
12610.48 1795320483.280069255 12610.48
"""
BUSYBOX = """\
12611.27 1795320484.073751000 12611.27
12611.27 1795320484.079062000 12611.28
12611.28 1795320484.083335000 12611.28
12611.28 1795320484.094121000 12611.29
12611.29 1795320484.098555000 12611.30
12611.30 1795320484.101990000 12611.30
"""


def parse_clock(text: str) -> Clock:
    bounds = clock.parse(text.splitlines())
    assert bounds is not None
    return bounds


def test_two_readings_of_one_boot_agree_to_a_few_milliseconds() -> None:
    before, after = parse_clock(COREUTILS), parse_clock(BUSYBOX)
    step = clock.clock_step(before, after)
    assert abs(step.step_s) <= step.error_s < 0.01
    assert clock.step_description(before, after) is None


def test_the_step_of_a_changed_reading_has_sign_and_uncertainty() -> None:
    earlier_readings = BUSYBOX.replace(" 1795320484.0", " 1795320483.9").replace(" 1795320484.1", " 1795320484.0")
    problem = clock.step_description(parse_clock(COREUTILS), parse_clock(earlier_readings))
    assert problem is not None
    assert problem.startswith("its clock was set back by 0.099 s (uncertainty 0.006 s)")
    later_readings = BUSYBOX.replace(" 1795320484", " 1795324084")
    assert (clock.step_description(parse_clock(COREUTILS), parse_clock(later_readings)) or "").startswith(
        "its clock was set ahead by 3600.0"
    )


def test_a_clock_in_whole_seconds_shows_larger_steps() -> None:
    seconds = "100.00 1000 100.01\n100.01 1000 100.02\n"
    assert clock.step_description(parse_clock(seconds), parse_clock("200.00 1100 200.01\n")) is None
    assert "set ahead by 3.005 s (uncertainty 1.015 s)" in (
        clock.step_description(parse_clock(seconds), parse_clock("200.00 1103 200.01\n")) or ""
    )


def test_a_clock_set_during_the_reading_is_detected() -> None:
    inconsistent_clock = parse_clock("1.00 50.000000000 1.00\n1.00 70.000000000 1.00\n")
    assert clock.step_description(inconsistent_clock, parse_clock(BUSYBOX)) == "its clock was set while it was read"


@pytest.mark.parametrize("text", ["", "1.0 2 3.0", "nothing", "1.00 1795320484.07 1.00", "12611.27  12611.27"])
def test_lines_without_a_time_are_ignored(text: str) -> None:
    assert clock.parse(text.splitlines()) is None


@dataclass(frozen=True)
class Robot:
    """A robot whose clock and time since boot have the same rate, even if the clock is slewed."""

    ahead_ns: int
    rate: float
    has_nanoseconds: bool


@dataclass(frozen=True)
class Moment:
    """Time of a reading, and durations of its parts."""

    true_ns: int
    pauses_ns: list[int]

    def read_clock(self, robot: Robot, step_ns: int = 0) -> Clock:
        lines, true_ns = [], self.true_ns
        for pause_ns in self.pauses_ns:
            at_ns = [round((true_ns + part * pause_ns // 2) * robot.rate) for part in range(3)]
            true_ns += pause_ns + 100_000
            uptime_texts = [f"{now // 10**9}.{now % 10**9 // 10**7:02d}" for now in (at_ns[0], at_ns[2])]
            wall_ns = at_ns[1] + robot.ahead_ns + step_ns
            wall_text = (
                f"{wall_ns // 10**9}.{wall_ns % 10**9:09d}" if robot.has_nanoseconds else str(wall_ns // 10**9)
            )
            lines.append(f"{uptime_texts[0]} {wall_text} {uptime_texts[1]}")
        return parse_clock("\n".join(lines))


ROBOTS = st.builds(Robot, st.integers(10**18, 2 * 10**18), st.floats(0.9, 1.1), st.booleans())
MOMENTS = st.builds(Moment, st.integers(10**9, 10**15), st.lists(st.integers(0, 3 * 10**9), min_size=1, max_size=8))


@given(ROBOTS, MOMENTS, MOMENTS)
def test_slewing_and_a_busy_robot_are_not_steps(robot: Robot, before: Moment, after: Moment) -> None:
    assert clock.step_description(before.read_clock(robot), after.read_clock(robot)) is None


@given(ROBOTS, MOMENTS, MOMENTS, st.integers(-(10**13), 10**13))
def test_a_step_is_within_its_uncertainty(robot: Robot, before: Moment, after: Moment, step_ns: int) -> None:
    first, second = before.read_clock(robot), after.read_clock(robot, step_ns)
    step = clock.clock_step(first, second)
    assert abs(step.step_s - step_ns / 1e9) <= step.error_s + 1e-6
    if abs(step_ns) / 1e9 > 2 * step.error_s + 1e-6:
        assert clock.step_description(first, second) is not None
