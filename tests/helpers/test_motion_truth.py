"""Times from motion as the lab knows it, on courses whose times are known, and what contradicts an expectation."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.helpers.motion_cells import CELLS, Blow, Craft, Moment, MotionCell, chosen, expected
from tests.helpers.motion_outcomes import MotionOutcome, problems
from tests.helpers.motion_parties import Party
from tests.helpers.motion_table import tables
from tests.helpers.motion_truth import MotionSample, descended_s, grounded_s, moved_again_m, stopped_s

OUT = MotionCell(Craft.ROVER, (Party.FIELDKIT,), Blow.KILL, Moment.OUT)
ROUTED = MotionCell(Craft.COPTER, (Party.ROUTER,), Blow.PAUSE, Moment.FLYING)
FLYING = MotionCell(Craft.COPTER, (Party.PILOT,), Blow.KILL, Moment.FLYING)


def course(
    speed_m_s: Callable[[float], float], rises_m_s: Callable[[float], float] = lambda _: 0.0
) -> list[MotionSample]:
    """Return 20 s of motion to the east, from 3 m up, integrated in steps of 10 ms."""
    samples, east_m, up_m = [], 0.0, 3.0
    for step in range(2000):
        at_s = step / 100
        east, up = speed_m_s(at_s), rises_m_s(at_s)
        east_m, up_m = east_m + east / 100, max(up_m + up / 100, 0.0)
        up = up if up_m > 0 else 0.0
        samples.append(MotionSample(at_s, east_m, 0.0, up_m, abs(east) + abs(up), up, 0.0, 0.0))
    return samples


def test_a_robot_that_brakes_has_stopped_when_it_stands_for_a_while() -> None:
    drives = course(lambda at_s: 0.6 if at_s < 5 or 7 <= at_s < 7.5 else 0.0)
    assert stopped_s(drives, 4.0) == pytest.approx(1.0, abs=0.02)
    assert stopped_s(drives, 4.0, 3.0) == pytest.approx(3.5, abs=0.02), "it was stationary for 2 s only"
    assert moved_again_m(drives, 5.5) == pytest.approx(0.3, abs=0.02)
    assert moved_again_m(drives, 8.0) == 0.0


def test_one_that_drives_on_has_not_stopped() -> None:
    assert stopped_s(course(lambda _: 0.6), 4.0) is None
    crawls = course(lambda at_s: 0.6 if at_s < 5 else 0.1)
    assert stopped_s(crawls, 4.0) is None


def test_a_turn_on_the_spot_is_motion() -> None:
    turns = [replaced._replace(turn_rad_s=0.5, heading_rad=0.5 * replaced.at_s) for replaced in course(lambda _: 0.0)]
    assert stopped_s(turns, 0.0) is None
    assert moved_again_m(turns, 19.0) == pytest.approx(0.25, abs=0.01)


def test_a_drone_descends_and_is_on_the_ground() -> None:
    lands = course(lambda _: 0.0, lambda at_s: -0.5 if at_s >= 6 else 0.0)
    assert descended_s(lands, 4.0) == pytest.approx(2.0, abs=0.02)
    assert grounded_s(lands, 4.0) == pytest.approx(8.0, abs=0.05)
    assert grounded_s(course(lambda _: 0.0), 4.0) is None, "it hovers"
    assert descended_s(course(lambda _: 1.0), 4.0) is None


GOOD = MotionOutcome(OUT.name, 1, begins_s=2.2, farthest_m=5.0)
LANDED = MotionOutcome(FLYING.name, 1, begins_s=1.5, ends_s=9.0, farthest_m=5.0, disarmed=True, alarm_s=2.0)


def test_what_is_within_its_bounds_is_no_problem() -> None:
    assert problems(ROUTED, replace(LANDED, link_lost=True)) == []
    assert problems(OUT, GOOD) == []
    assert problems(FLYING, LANDED) == []


@pytest.mark.parametrize(
    ("cell", "seen", "why"),
    [
        (OUT, replace(GOOD, begins_s=None), "never"),
        (OUT, replace(GOOD, begins_s=20.0), "stops after 20.0 s"),
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
def test_what_is_beyond_is_one(cell: MotionCell, seen: MotionOutcome, why: str) -> None:
    assert any(why in problem for problem in problems(cell, seen))


def test_each_party_and_each_pair_is_hit_in_each_phase() -> None:
    singles = {(cell.craft, *cell.parties, cell.moment) for cell in CELLS if len(cell.parties) == 1}
    assert (Craft.ROVER, Party.AGENT, Moment.BACK) in singles
    assert (Craft.PX4, Party.GUARD, Moment.LANDING) in singles
    pairs = {frozenset(cell.parties) for cell in CELLS if cell.craft is Craft.COPTER and len(cell.parties) == 2}
    on_drone = (Party.PILOT, Party.GUARD, Party.SERVER, Party.ROUTER)
    assert pairs >= {frozenset({one, other}) for one in on_drone for other in on_drone if one is not other}
    assert len({cell.name for cell in CELLS}) == len(CELLS)
    assert all(expected(cell).does for cell in CELLS)


def test_cells_are_chosen_by_name() -> None:
    assert [cell.name for cell in chosen("rover/agent/kill/*")] == [
        f"rover/agent/kill/{moment}" for moment in ("waiting", "out", "there", "back")
    ]
    with pytest.raises(ValueError, match="no cell matches"):
        chosen("rover/pilot/*")


def test_a_table_shows_the_median_and_the_phase_of_the_maximum() -> None:
    again = MotionOutcome("rover/fieldkit/kill/back", 1, begins_s=2.6)
    late = replace(again, begins_s=2.8, problems=("late",))
    text = tables([GOOD, again, late, LANDED], "today")
    assert "| fieldkit | killed | agent: lease | stops, stays | 2.9 | 2.6 | 2.8 (back) | 3 | 1 |" in text
    assert "4 trials, 1 beyond" in text
    assert "### Drone with ArduCopter" in text
    assert "PX4" not in text
