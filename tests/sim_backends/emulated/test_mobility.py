"""Mobility updates the medium while robots move, and returns them at the end of a move, also after an error."""

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
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.mobility import STEP_M, Mobility
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.ros.assigned_path import AssignedPath
from sim_backends.emulated.ros.motion_record import RecordedMotion
from sim_backends.world.motion import STILL, Attitude
from sim_backends.world.world import load_world
from tests.helpers.casts import CAST
from tests.helpers.sshd import wait_until

MOVE = Move(Role.SENDER, (Leg(away_m=0.4),), 2.0)
FAR = Move(Role.SENDER, (Leg(away_m=1e5),), 5.0)


@dataclass
class RecordingMedium:
    """A medium that records its calls."""

    calls: list[tuple[Mapping[str, Vector], Mapping[str, Vector]]] = field(default_factory=list)
    attitudes: Mapping[str, Attitude] = field(default_factory=dict)
    fails: bool = False

    def place(
        self,
        positions_m: Mapping[str, Vector],
        *,
        relay: str | None,
        velocities_m_s: Mapping[str, Vector],
        attitudes: Mapping[str, Attitude],
    ) -> None:
        if self.fails:
            raise LinkError("does not answer", where="medium", remedy="start the lab again")
        assert relay is None or relay in positions_m
        self.calls.append((dict(positions_m), dict(velocities_m_s)))
        self.attitudes = attitudes

    def positions_of(self, role: Role) -> list[Vector | None]:
        return [positions.get(CAST[role].name) for positions, _ in self.calls]

    def position_of(self, role: Role) -> Vector | None:
        return self.positions_of(role)[-1]


@pytest.fixture
def medium() -> RecordingMedium:
    return RecordingMedium()


@pytest.fixture
def mobility(medium: RecordingMedium) -> Mobility:
    mobility = Mobility(CAST, cast("MediumClient", medium), load_world("lawn"), None)
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    return mobility


def motion_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "motion"]


def wait(condition: Callable[[], bool]) -> None:
    wait_until(condition, Deadline.after(60))


def test_a_robot_moves_along_its_path_and_returns_to_its_place(mobility: Mobility, medium: RecordingMedium) -> None:
    place = medium.position_of(Role.SENDER)
    assert place is not None
    others = medium.positions_of(Role.RELAY) + medium.positions_of(Role.RECEIVER)
    with mobility.moving(MOVE):
        wait(lambda: not motion_threads())  # there are no more updates after the end of the path
        assert medium.position_of(Role.SENDER) == pytest.approx((place[0] - 0.4, *place[1:]))
        assert medium.calls[-1][1][CAST[Role.SENDER].name] == (0.0, 0.0, 0.0)
    assert medium.position_of(Role.SENDER) == place
    eastings_m = [position_m[0] for position_m in medium.positions_of(Role.SENDER)[1:-1] if position_m is not None]
    assert eastings_m == sorted(eastings_m, reverse=True)
    velocities = [velocity[CAST[Role.SENDER].name] for _, velocity in medium.calls[1:-2]]
    assert velocities
    assert all(velocity == pytest.approx((-2.0, 0.0, 0.0)) for velocity in velocities)
    assert set(medium.positions_of(Role.RELAY) + medium.positions_of(Role.RECEIVER)) == set(others)


@pytest.mark.parametrize("error", [RobotError("x", remedy="y"), KeyboardInterrupt()])
def test_after_an_error_the_robot_is_at_its_place_and_no_thread_runs(
    mobility: Mobility, medium: RecordingMedium, error: BaseException
) -> None:
    place = medium.position_of(Role.SENDER)

    def move_and_fail() -> None:
        with mobility.moving(FAR):
            wait(lambda: len(medium.calls) > 3)
            assert medium.position_of(Role.SENDER) != place
            raise error

    with pytest.raises(type(error)):
        move_and_fail()
    assert motion_threads() == []
    assert medium.position_of(Role.SENDER) == place


def test_an_error_of_the_medium_is_raised_when_the_context_is_left(
    mobility: Mobility, medium: RecordingMedium
) -> None:
    def move_and_fail() -> None:
        with mobility.moving(FAR):
            medium.fails = True
            wait(lambda: not motion_threads())
            medium.fails = False  # so that only the thread has the error

    with pytest.raises(LinkError):
        move_and_fail()


def test_a_moving_robot_that_returns_into_range_is_at_its_current_position(
    mobility: Mobility, medium: RecordingMedium
) -> None:
    place = medium.position_of(Role.SENDER)
    with mobility.moving(FAR):
        mobility.set_out_of_range(Role.SENDER)
        calls = len(medium.calls)
        wait(lambda: len(medium.calls) > calls + 2)
        assert set(medium.positions_of(Role.SENDER)[calls - 1 :]) == {None}
        mobility.set_out_of_range(None)
        assert medium.position_of(Role.SENDER) not in {None, place}
    since_ns = 0
    absent = [point for point in mobility.track(since_ns) if point.role is Role.SENDER and point.position_m is None]
    assert len(absent) == 1, "one entry without a position until it is back"


def test_two_robots_can_move_at_the_same_time(mobility: Mobility, medium: RecordingMedium) -> None:
    with mobility.moving(MOVE), mobility.moving(Move(Role.RECEIVER, (Leg(left_m=0.3), Leg(away_m=-0.2)), 2.0)):
        wait(lambda: not motion_threads())
        sender, receiver = medium.position_of(Role.SENDER), medium.position_of(Role.RECEIVER)
    assert sender is not None
    assert receiver is not None
    (first_positions, _), (last_positions, _) = medium.calls[0], medium.calls[-1]
    assert first_positions == last_positions
    assert sender[0] - first_positions[CAST[Role.SENDER].name][0] == pytest.approx(-0.4)
    start_m = first_positions[CAST[Role.RECEIVER].name]
    assert receiver == pytest.approx((start_m[0] - 0.2, start_m[1] + 0.3, start_m[2]))


def test_the_track_equals_the_positions_of_the_medium_and_discards_old_ones(
    mobility: Mobility, medium: RecordingMedium
) -> None:
    with mobility.moving(MOVE):
        wait(lambda: not motion_threads())
    track = mobility.track(0)
    assert [point.position_m for point in track if point.role is Role.SENDER] == medium.positions_of(Role.SENDER)
    assert all(point.utc_ns <= next_point.utc_ns for point, next_point in pairwise(track))
    assert [point.role for point in track].count(Role.RELAY) == 1
    last_points = mobility.track(time.time_ns())
    assert sorted(point.role for point in last_points) == sorted(CAST)
    assert mobility.track(0) == last_points


def test_the_update_period_depends_on_the_speed(mobility: Mobility, medium: RecordingMedium) -> None:
    """The test compares the periods that updates return, because actual periods are longer on a busy machine."""
    slow_move, fast_move = (Move(Role.SENDER, (Leg(away_m=1e5),), speed_m_s) for speed_m_s in (0.2, 50.0))
    periods_s = []
    for move in (slow_move, Move(Role.SENDER, (Leg(away_m=1e5),), 2.0), fast_move):
        with mobility.moving(move):
            wait(lambda: any(any(velocity.values()) for _, velocity in medium.calls[-1:]))
            periods_s.append(mobility._update_medium())
    assert periods_s == [0.1, STEP_M / 2.0, 0.02]


def test_moving_without_a_placement_is_an_error(medium: RecordingMedium) -> None:
    empty = Mobility(CAST, cast("MediumClient", medium), load_world("lawn"), None)
    with pytest.raises(RobotError, match="have not been placed yet"), empty.moving(MOVE):
        raise AssertionError


@pytest.mark.parametrize("role", FIXED_ROLES)
def test_a_leg_away_increases_the_distance_to_the_other_end(
    mobility: Mobility, medium: RecordingMedium, role: Role
) -> None:
    other_name = CAST[Role.RELAY if role is not Role.RELAY else Role.SENDER].name
    positions_before = medium.calls[-1][0]
    with mobility.moving(Move(role, (Leg(away_m=0.1),), 2.0)):
        wait(lambda: not motion_threads())
        positions_after = medium.calls[-1][0]
    name = CAST[role].name
    assert math.dist(positions_after[name], positions_after[other_name]) == pytest.approx(
        math.dist(positions_before[name], positions_before[other_name]) + 0.1
    )


@dataclass
class SteeringRobot:
    """A robot that steers itself."""

    spec: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(steers=True))
    paths: list[AssignedPath] = field(default_factory=list)
    last_recorded_motion: RecordedMotion | None = None

    def move(self, path: AssignedPath) -> None:
        self.paths.append(path)

    def recorded_motion(self) -> RecordedMotion | None:
        return self.last_recorded_motion

    def record(self, place_m: Vector, velocity_m_s: Vector = STILL) -> None:
        self.last_recorded_motion = RecordedMotion(
            time.monotonic_ns(), self.paths[-1].start_ns, place_m, velocity_m_s
        )


@pytest.fixture
def flying_drone(medium: RecordingMedium) -> tuple[Mobility, SteeringRobot]:
    robot = SteeringRobot()
    robots = cast("Mapping[Role, EmulatedRobot]", {Role.RELAY: robot})
    mobility = Mobility(CAST, cast("MediumClient", medium), load_world("lawn"), None, robots)
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    return mobility, robot


def test_the_medium_follows_a_robot_that_steers_itself_until_the_lab_places_it(
    medium: RecordingMedium, flying_drone: tuple[Mobility, SteeringRobot]
) -> None:
    mobility, robot = flying_drone
    place = medium.position_of(Role.RELAY)
    with mobility.watching():
        robot.record((7.0, 8.0, 9.0), (0.0, 0.0, 5.0))
        wait(lambda: medium.position_of(Role.RELAY) != place)
        robot.record((7.0, 8.0, 12.0))
        wait(lambda: medium.position_of(Role.RELAY) == (7.0, 8.0, 12.0))
        calls = len(medium.calls)
        mobility.set_out_of_range(Role.SENDER)  # an update for another reason includes its position
        assert medium.position_of(Role.RELAY) == (7.0, 8.0, 12.0)
        mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
        assert medium.position_of(Role.RELAY) == place
        robot.last_recorded_motion = RecordedMotion(time.monotonic_ns(), robot.paths[0].start_ns, (1.0, 2.0, 3.0))
        mobility.set_out_of_range(None)
        assert medium.position_of(Role.RELAY) == place, "motion from before the placement is ignored"
    assert len(medium.calls) > calls
    assert not [thread for thread in threading.enumerate() if thread.name == "watch"]
    track = [point.position_m for point in mobility.track(0) if point.role is Role.RELAY]
    assert (7.0, 8.0, 12.0) in track
    assert track[0] == track[-1] == place


def test_the_medium_receives_the_attitudes_of_robots(
    medium: RecordingMedium, flying_drone: tuple[Mobility, SteeringRobot]
) -> None:
    mobility, robot = flying_drone
    drone, sender, receiver = (CAST[role].name for role in (Role.RELAY, Role.SENDER, Role.RECEIVER))
    east, west = Attitude(0.0), Attitude(math.pi)
    assert [medium.attitudes[name].yaw_rad for name in (sender, receiver)] == pytest.approx(
        [west.yaw_rad, east.yaw_rad]
    ), "they face away from each other"
    start_ns = robot.paths[-1].start_ns
    robot.last_recorded_motion = RecordedMotion(
        time.monotonic_ns(), start_ns, (7.0, 8.0, 9.0), heading_rad=1.0, tilt_rad=(0.1, 0.2)
    )
    with mobility.moving(Move(Role.SENDER, (Leg(left_m=0.2),), 2.0)):
        wait(lambda: not motion_threads())
        assert medium.attitudes[drone] == Attitude(yaw_rad=1.0, pitch_rad=0.2, roll_rad=0.1)
        assert medium.attitudes[sender].yaw_rad == pytest.approx(-math.pi / 2), "left of west, also after the move"
    assert medium.attitudes[sender].yaw_rad == pytest.approx(west.yaw_rad)


def test_the_time_of_the_track_is_that_of_the_positions(
    medium: RecordingMedium, flying_drone: tuple[Mobility, SteeringRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    mobility, robot = flying_drone
    place_times_ns: list[int] = []
    monkeypatch.setattr(medium, "place", lambda *_, **__: place_times_ns.append(time.time_ns()))
    robot.record((7.0, 8.0, 9.0), (0.0, 0.0, 5.0))
    mobility.set_out_of_range(Role.SENDER)
    last_point = [point for point in mobility.track(0) if point.role is Role.RELAY][-1]
    assert last_point.velocity_m_s == (0.0, 0.0, 5.0)
    assert last_point.utc_ns <= place_times_ns[-1], "the robot may have stopped before the medium answered"


def test_a_driving_robot_stays_on_the_ground_and_a_silent_one_stops(medium: RecordingMedium) -> None:
    robot = SteeringRobot()
    robots = cast("Mapping[Role, EmulatedRobot]", {Role.SENDER: robot})
    mobility = Mobility(CAST, cast("MediumClient", medium), load_world("lawn"), None, robots)
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    place = medium.position_of(Role.SENDER)
    assert place is not None
    robot.record((7.0, 8.0, 55.0), (1.0, 0.0, 0.0))
    with mobility.watching():
        wait(lambda: medium.position_of(Role.SENDER) == (7.5, 8.0, place[2]))
    assert medium.calls[-1][1][CAST[Role.SENDER].name] == STILL


def test_lasers_detect_robots_except_those_that_are_out_of_range(medium: RecordingMedium) -> None:
    written_positions: list[Mapping[str, Vector]] = []
    mobility = Mobility(
        CAST, cast("MediumClient", medium), load_world("lawn"), None, write_positions=written_positions.append
    )
    mobility.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("10m")))
    assert written_positions[-1] == medium.calls[-1][0]
    mobility.set_out_of_range(Role.RELAY)  # no radio reaches another one, but the other robots keep their positions
    assert medium.calls[-1][0] == {}
    assert written_positions[-1] == {
        name: place_m for name, place_m in written_positions[0].items() if name != CAST[Role.RELAY].name
    }
