"""Tests of times from ground-truth motion with known times, and of the comparison with expectations."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.helpers.motion_cells import CELLS, Craft, InjectedFault, Moment, MotionCell, expected, select_cells
from tests.helpers.motion_outcomes import MotionOutcome, problems
from tests.helpers.motion_parties import Party
from tests.helpers.motion_table import tables
from tests.helpers.motion_truth import MotionSample, descended_s, grounded_s, moved_again_m, stopped_s

OUT = MotionCell(Craft.ROVER, (Party.FIELDKIT,), InjectedFault.KILL, Moment.OUT)
ROUTED = MotionCell(Craft.COPTER, (Party.ROUTER,), InjectedFault.PAUSE, Moment.FLYING)
FLYING = MotionCell(Craft.COPTER, (Party.PILOT,), InjectedFault.KILL, Moment.FLYING)


def course(
    speed_m_s: Callable[[float], float], rises_m_s: Callable[[float], float] = lambda _: 0.0
) -> list[MotionSample]:
    """Samples of 20 s of motion to the east, starting 3 m above the ground, in steps of 10 ms."""
    samples, east_m, up_m = [], 0.0, 3.0
    for step in range(2000):
        at_s = step / 100
        east, up = speed_m_s(at_s), rises_m_s(at_s)
        east_m, up_m = east_m + east / 100, max(up_m + up / 100, 0.0)
        up = up if up_m > 0 else 0.0
        samples.append(MotionSample(at_s, east_m, 0.0, up_m, abs(east) + abs(up), up, 0.0, 0.0))
    return samples


def test_a_robot_has_stopped_once_it_is_stationary_for_the_given_time() -> None:
    samples = course(lambda at_s: 0.6 if at_s < 5 or 7 <= at_s < 7.5 else 0.0)
    assert stopped_s(samples, 4.0) == pytest.approx(1.0, abs=0.02)
    assert stopped_s(samples, 4.0, 3.0) == pytest.approx(3.5, abs=0.02), "it was stationary for 2 s only"
    assert moved_again_m(samples, 5.5) == pytest.approx(0.3, abs=0.02)
    assert moved_again_m(samples, 8.0) == 0.0


def test_a_robot_that_continues_to_drive_has_not_stopped() -> None:
    assert stopped_s(course(lambda _: 0.6), 4.0) is None
    slow_course = course(lambda at_s: 0.6 if at_s < 5 else 0.1)
    assert stopped_s(slow_course, 4.0) is None


def test_a_turn_on_the_spot_is_motion() -> None:
    turning = [sample._replace(turn_rad_s=0.5, heading_rad=0.5 * sample.at_s) for sample in course(lambda _: 0.0)]
    assert stopped_s(turning, 0.0) is None
    assert moved_again_m(turning, 19.0) == pytest.approx(0.25, abs=0.01)


def test_the_times_of_a_descent_and_a_landing_are_measured() -> None:
    landing = course(lambda _: 0.0, lambda at_s: -0.5 if at_s >= 6 else 0.0)
    assert descended_s(landing, 4.0) == pytest.approx(2.0, abs=0.02)
    assert grounded_s(landing, 4.0) == pytest.approx(8.0, abs=0.05)
    assert grounded_s(course(lambda _: 0.0), 4.0) is None, "the drone hovers"
    assert descended_s(course(lambda _: 1.0), 4.0) is None


(STOPPED,) = select_cells("rover/fieldkit+operator/stop/out")
GOOD = MotionOutcome(OUT.name, 1, begins_s=2.2, farthest_m=5.0)
LANDED = MotionOutcome(FLYING.name, 1, begins_s=1.5, ends_s=9.0, farthest_m=5.0, disarmed=True, alarm_s=2.0)


def test_an_outcome_within_its_limits_has_no_problems() -> None:
    assert problems(ROUTED, replace(LANDED, link_lost=True)) == []
    assert problems(OUT, GOOD) == []
    assert problems(FLYING, LANDED) == []
    assert problems(STOPPED, replace(GOOD, begins_s=2.2, scheduling_s=0.4)) == []


@pytest.mark.parametrize(
    ("cell", "outcome", "message"),
    [
        (OUT, replace(GOOD, begins_s=None), "never"),
        (OUT, replace(GOOD, begins_s=20.0), "stops after 20.0 s"),
        (STOPPED, replace(GOOD, begins_s=2.2, scheduling_s=0.2), "bound 1.9 s and 0.2 s without a processor"),
        (STOPPED, replace(GOOD, begins_s=3.0, scheduling_s=8.0), "bound 1.9 s and 1.0 s without a processor"),
        (OUT, replace(GOOD, again_m=0.2), "moves again"),
        (OUT, replace(GOOD, attempts=2), "set in motion 2 times"),
        (OUT, replace(GOOD, farthest_m=31.5), "beyond its fence"),
        (FLYING, replace(LANDED, begins_s=20.0), "descends after 20.0 s"),
        (FLYING, replace(LANDED, ends_s=None), "on the ground: never"),
        (FLYING, replace(LANDED, disarmed=False), "still armed"),
        (FLYING, replace(LANDED, disarmed=False, alarm_s=None), "no alarm"),
        (FLYING, replace(LANDED, disarmed=False, alarm_s=60.0), "alarm after 60.0 s"),
        (ROUTED, replace(LANDED, link_lost=False), "was not lost"),
        (ROUTED, replace(LANDED, link_lost=None), "was not lost"),
    ],
)
def test_an_outcome_beyond_a_limit_has_a_problem(cell: MotionCell, outcome: MotionOutcome, message: str) -> None:
    assert any(message in problem for problem in problems(cell, outcome))


def test_the_cells_cover_each_party_and_each_pair() -> None:
    singles = {(cell.craft, *cell.parties, cell.moment) for cell in CELLS if len(cell.parties) == 1}
    assert (Craft.ROVER, Party.AGENT, Moment.BACK) in singles
    assert (Craft.PX4, Party.GUARD, Moment.LANDING) in singles
    pairs = {frozenset(cell.parties) for cell in CELLS if cell.craft is Craft.COPTER and len(cell.parties) == 2}
    drone_parties = (Party.PILOT, Party.GUARD, Party.SERVER, Party.ROUTER)
    assert pairs >= {
        frozenset({first, second}) for first in drone_parties for second in drone_parties if first is not second
    }
    assert len({cell.name for cell in CELLS}) == len(CELLS)
    assert all(expected(cell).does for cell in CELLS)


def test_cells_are_selected_by_patterns_of_their_names() -> None:
    assert [cell.name for cell in select_cells("rover/agent/kill/*")] == [
        f"rover/agent/kill/{moment}" for moment in ("waiting", "out", "there", "back")
    ]
    with pytest.raises(ValueError, match="no cell matches"):
        select_cells("rover/pilot/*")


def test_a_table_shows_the_median_and_the_phase_of_the_maximum() -> None:
    early = MotionOutcome("rover/fieldkit/kill/back", 1, begins_s=2.6)
    late = replace(early, begins_s=2.8, problems=("late",))
    text = tables([GOOD, early, late, LANDED], "today")
    assert "| fieldkit | killed | agent: lease | stops, stays | 2.9 | 2.6 | 2.8 (back) | 3 | 1 |" in text
    assert "4 trials, 1 beyond" in text
    assert "### Drone with ArduCopter" in text
    assert "PX4" not in text
