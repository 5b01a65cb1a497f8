"""Mobility tells the medium where robots are while they move, and that they are back, whatever ended the move."""

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.core.model import FIXED_ROLES, Leg, Move, Placement, Role, Scenario, Topology, Vector
from fieldkit.core.units import parse_distance
from sim_backends.emulated.medium.client import MediumClient
from sim_backends.emulated.mobility import STEP_M, Mobility
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.ros.own_motion import AssignedPath
from sim_backends.emulated.ros.steered import Steered
from sim_backends.world.motion import STILL
from sim_backends.world.world import load_world
from tests.helpers.casts import CAST
from tests.helpers.sshd import wait_until

AWAY = Move(Role.SENDER, (Leg(away_m=0.4),), 2.0)
FAR = Move(Role.SENDER, (Leg(away_m=1e5),), 5.0)


@dataclass
class Told:
    """What a medium was told."""

    calls: list[tuple[Mapping[str, Vector], Mapping[str, Vector]]] = field(default_factory=list)
    gone: bool = False

    def place(
        self, positions_m: Mapping[str, Vector], *, relay: str | None, velocities_m_s: Mapping[str, Vector]
    ) -> None:
        if self.gone:
            raise LinkError("does not answer", where="medium", remedy="start the lab again")
        assert relay is None or relay in positions_m
        self.calls.append((dict(positions_m), dict(velocities_m_s)))

    def of(self, role: Role) -> list[Vector | None]:
        return [positions.get(CAST[role].name) for positions, _ in self.calls]

    def now(self, role: Role) -> Vector | None:
        return self.of(role)[-1]


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture
def mobility(told: Told) -> Mobility:
    mobility = Mobility(CAST, cast("MediumClient", told), load_world("lawn"), None)
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    return mobility


def in_motion() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "motion"]


def wait(condition: Callable[[], bool]) -> None:
    wait_until(condition, Deadline.after(60))


def test_a_robot_goes_its_way_stands_at_its_end_and_is_back(mobility: Mobility, told: Told) -> None:
    place = told.now(Role.SENDER)
    assert place is not None
    others = told.of(Role.RELAY) + told.of(Role.RECEIVER)
    with mobility.moving(AWAY):
        wait(lambda: not in_motion())  # nobody is told any more of who stands
        assert told.now(Role.SENDER) == pytest.approx((place[0] - 0.4, *place[1:]))
        assert told.calls[-1][1][CAST[Role.SENDER].name] == (0.0, 0.0, 0.0)
    assert told.now(Role.SENDER) == place
    on_the_way = [at[0] for at in told.of(Role.SENDER)[1:-1] if at is not None]
    assert on_the_way == sorted(on_the_way, reverse=True)
    velocities = [velocity[CAST[Role.SENDER].name] for _, velocity in told.calls[1:-2]]
    assert velocities
    assert all(velocity == pytest.approx((-2.0, 0.0, 0.0)) for velocity in velocities)
    assert set(told.of(Role.RELAY) + told.of(Role.RECEIVER)) == set(others)


@pytest.mark.parametrize("error", [RobotError("x", remedy="y"), KeyboardInterrupt()])
def test_whatever_ends_it_it_is_back_and_nobody_goes_on(mobility: Mobility, told: Told, error: BaseException) -> None:
    place = told.now(Role.SENDER)

    def break_off() -> None:
        with mobility.moving(FAR):
            wait(lambda: len(told.calls) > 3)
            assert told.now(Role.SENDER) != place
            raise error

    with pytest.raises(type(error)):
        break_off()
    assert in_motion() == []
    assert told.now(Role.SENDER) == place


def test_a_medium_that_is_gone_is_told_of_at_the_end(mobility: Mobility, told: Told) -> None:
    def break_off() -> None:
        with mobility.moving(FAR):
            told.gone = True
            wait(lambda: not in_motion())
            told.gone = False  # so that only that thread has met it

    with pytest.raises(LinkError):
        break_off()


def test_who_is_out_of_range_on_its_way_comes_back_where_it_is_by_then(mobility: Mobility, told: Told) -> None:
    place = told.now(Role.SENDER)
    with mobility.moving(FAR):
        mobility.set_out_of_range(Role.SENDER)
        calls = len(told.calls)
        wait(lambda: len(told.calls) > calls + 2)
        assert set(told.of(Role.SENDER)[calls - 1 :]) == {None}
        mobility.set_out_of_range(None)
        assert told.now(Role.SENDER) not in {None, place}
    since_ns = 0
    absent = [one for one in mobility.track(since_ns) if one.role is Role.SENDER and one.position_m is None]
    assert len(absent) == 1, "who is nowhere is nowhere until it is back"


def test_two_may_move_at_once(mobility: Mobility, told: Told) -> None:
    with mobility.moving(AWAY), mobility.moving(Move(Role.RECEIVER, (Leg(left_m=0.3), Leg(away_m=-0.2)), 2.0)):
        wait(lambda: not in_motion())
        sender, receiver = told.now(Role.SENDER), told.now(Role.RECEIVER)
    assert sender is not None
    assert receiver is not None
    (first, _), (last, _) = told.calls[0], told.calls[-1]
    assert first == last
    assert sender[0] - first[CAST[Role.SENDER].name][0] == pytest.approx(-0.4)
    at = first[CAST[Role.RECEIVER].name]
    assert receiver == pytest.approx((at[0] - 0.2, at[1] + 0.3, at[2]))


def test_the_track_says_what_the_medium_was_told_and_forgets_what_is_over(mobility: Mobility, told: Told) -> None:
    with mobility.moving(AWAY):
        wait(lambda: not in_motion())
    track = mobility.track(0)
    assert [one.position_m for one in track if one.role is Role.SENDER] == told.of(Role.SENDER)
    assert all(one.utc_ns <= other.utc_ns for one, other in pairwise(track))
    assert [one.role for one in track].count(Role.RELAY) == 1
    kept = mobility.track(time.time_ns())
    assert sorted(one.role for one in kept) == sorted(CAST)
    assert mobility.track(0) == kept


def test_steps_are_as_short_as_the_speed_asks(mobility: Mobility, told: Told) -> None:
    """By what the next step is due at: a busy machine makes each as long as it likes."""
    slow, fast = (Move(Role.SENDER, (Leg(away_m=1e5),), speed_m_s) for speed_m_s in (0.2, 50.0))
    due = []
    for move in (slow, Move(Role.SENDER, (Leg(away_m=1e5),), 2.0), fast):
        with mobility.moving(move):
            wait(lambda: any(any(velocity.values()) for _, velocity in told.calls[-1:]))
            due.append(mobility._tell())
    assert due == [0.1, STEP_M / 2.0, 0.02]


def test_nobody_moves_without_a_place(told: Told) -> None:
    empty = Mobility(CAST, cast("MediumClient", told), load_world("lawn"), None)
    with pytest.raises(RobotError, match="no places"), empty.moving(AWAY):
        raise AssertionError


@pytest.mark.parametrize("role", FIXED_ROLES)
def test_away_is_away_from_the_other_end(mobility: Mobility, told: Told, role: Role) -> None:
    other = CAST[Role.RELAY if role is not Role.RELAY else Role.SENDER].name
    before = told.calls[-1][0]
    with mobility.moving(Move(role, (Leg(away_m=0.1),), 2.0)):
        wait(lambda: not in_motion())
        after = told.calls[-1][0]
    name = CAST[role].name
    assert math.dist(after[name], after[other]) == pytest.approx(math.dist(before[name], before[other]) + 0.1)


@dataclass
class Steering:
    """A robot that steers itself."""

    spec: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(steers=True))
    ways: list[AssignedPath] = field(default_factory=list)
    said: Steered | None = None

    def move(self, way: AssignedPath) -> None:
        self.ways.append(way)

    def steered(self) -> Steered | None:
        return self.said

    def say(self, place_m: Vector, velocity_m_s: Vector = STILL) -> None:
        self.said = Steered(time.monotonic_ns(), self.ways[-1].began_ns, place_m, velocity_m_s)


@pytest.fixture
def flying(told: Told) -> tuple[Mobility, Steering]:
    robot = Steering()
    robots = cast("Mapping[Role, EmulatedRobot]", {Role.RELAY: robot})
    mobility = Mobility(CAST, cast("MediumClient", told), load_world("lawn"), None, robots)
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    return mobility, robot


def test_the_medium_follows_who_steers_itself_until_it_is_carried_off(
    told: Told, flying: tuple[Mobility, Steering]
) -> None:
    mobility, robot = flying
    place = told.now(Role.RELAY)
    with mobility.watching():
        robot.say((7.0, 8.0, 9.0), (0.0, 0.0, 5.0))
        wait(lambda: told.now(Role.RELAY) != place)
        robot.say((7.0, 8.0, 12.0))
        wait(lambda: told.now(Role.RELAY) == (7.0, 8.0, 12.0))
        calls = len(told.calls)
        mobility.set_out_of_range(Role.SENDER)  # whoever tells of something else tells of it, too
        assert told.now(Role.RELAY) == (7.0, 8.0, 12.0)
        mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
        assert told.now(Role.RELAY) == place
        robot.said = Steered(time.monotonic_ns(), robot.ways[0].began_ns, (1.0, 2.0, 3.0))
        mobility.set_out_of_range(None)
        assert told.now(Role.RELAY) == place, "what it says of where it was before is over"
    assert len(told.calls) > calls
    assert not [thread for thread in threading.enumerate() if thread.name == "watch"]
    track = [one.position_m for one in mobility.track(0) if one.role is Role.RELAY]
    assert (7.0, 8.0, 12.0) in track
    assert track[0] == track[-1] == place


def test_who_drives_stays_on_the_ground_and_one_that_is_silent_stands(told: Told) -> None:
    robot = Steering()
    robots = cast("Mapping[Role, EmulatedRobot]", {Role.SENDER: robot})
    mobility = Mobility(CAST, cast("MediumClient", told), load_world("lawn"), None, robots)
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    place = told.now(Role.SENDER)
    assert place is not None
    robot.say((7.0, 8.0, 55.0), (1.0, 0.0, 0.0))
    with mobility.watching():
        wait(lambda: told.now(Role.SENDER) == (7.5, 8.0, place[2]))
    assert told.calls[-1][1][CAST[Role.SENDER].name] == STILL


def test_lasers_see_who_is_in_place_and_not_who_is_away(told: Told) -> None:
    shown: list[Mapping[str, Vector]] = []
    mobility = Mobility(CAST, cast("MediumClient", told), load_world("lawn"), None, show=shown.append)
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    assert shown[-1] == told.calls[-1][0]
    mobility.set_out_of_range(Role.RELAY)  # no radio reaches another one, but the others are where they were
    assert told.calls[-1][0] == {}
    assert shown[-1] == {name: place_m for name, place_m in shown[0].items() if name != CAST[Role.RELAY].name}
