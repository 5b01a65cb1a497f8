"""Motion of a robot for its sensors: odometry is the integral of its speed, and positions are those of the world."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from fieldkit.core.model import Leg, Move, Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from sim_backends.emulated import placement as places
from sim_backends.emulated.ros.assigned_path import AssignedPath, append_path
from sim_backends.emulated.ros.messages import FIX_NOISE_M, Source
from sim_backends.emulated.ros.robot_motion import AT_REST, Odometer, RobotMotionState
from sim_backends.emulated.ros.sensor_specs import Sensor
from sim_backends.world.world import load_world
from tests.helpers.casts import CAST

S = 10**9
UP_M = 0.2
CORNER = ((3.0, 6.0, UP_M), (7.0, 6.0, UP_M), (7.0, 8.0, 1.2))
METRES = st.floats(-50, 50)
POINTS = st.lists(st.tuples(METRES, METRES, st.just(UP_M)), min_size=1, max_size=5)
ANGLES = st.floats(-math.pi, math.pi)


def write_paths(folder: Path, *assigned_paths: AssignedPath) -> Path:
    path = folder / "motion"
    path.unlink(missing_ok=True)
    for assigned_path in assigned_paths:
        append_path(path, assigned_path)
    return path


def test_odometry_follows_a_path_with_a_left_turn(tmp_path: Path) -> None:
    odometer = Odometer(write_paths(tmp_path, AssignedPath(10 * S, CORNER, 2.0, 0.0)), 0)
    assert odometer.at(10 * S) == RobotMotionState(speed_m_s=2.0, position_m=CORNER[0])
    assert odometer.at(11 * S) == RobotMotionState(2.0, 0.0, 0.0, 2.0, (5.0, 6.0, UP_M))
    middle = odometer.at(round(12.5 * S))
    assert (middle.x_m, middle.y_m, middle.yaw_rad) == pytest.approx((4.0, 1.0, math.pi / 2))
    assert middle.position_m == pytest.approx((7.0, 7.0, 0.7)), "half way up"
    end = odometer.at(20 * S)
    assert (end.x_m, end.y_m, end.yaw_rad, end.speed_m_s) == pytest.approx((4.0, 2.0, math.pi / 2, 0.0))
    assert end.position_m == CORNER[-1]


def test_a_robot_that_is_placed_again_keeps_its_odometry(tmp_path: Path) -> None:
    path = write_paths(tmp_path, AssignedPath(0, CORNER, 2.0, 0.0))
    odometer = Odometer(path, 0)
    odometer.at(2 * S)
    append_path(path, AssignedPath(4 * S, CORNER[:1], 2.0, 0.0))
    placed_motion = odometer.at(5 * S)
    assert (placed_motion.x_m, placed_motion.y_m) == pytest.approx((4.0, 2.0))
    assert placed_motion.position_m == CORNER[0]
    append_path(path, AssignedPath(6 * S, CORNER, 2.0, 0.0))
    second_drive = odometer.at(7 * S)
    # The robot was turned to its first heading, which its odometry has not recorded: ahead is to the left of the
    # start in its odometry frame.
    assert (second_drive.x_m, second_drive.y_m, second_drive.yaw_rad) == pytest.approx((4.0, 4.0, math.pi / 2))


def test_a_missing_file_or_an_incomplete_line_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "motion"
    odometer = Odometer(path, 0)
    assert odometer.at(S) == AT_REST
    path.write_text('{"start_ns": 0, "points_m": [[1.0,', encoding="ascii")
    assert odometer.at(2 * S) == AT_REST
    path.write_text('{"start_ns": 0, "points_m": [[1.0, 2.0, 0.2]], "speed_m_s": 1.0, "facing_rad": 0.0}\n')
    assert odometer.at(3 * S).position_m == (1.0, 2.0, UP_M)


@given(POINTS, ANGLES, st.floats(0.1, 3), st.integers(0, 100 * S))
def test_odometry_starts_at_zero_when_it_is_created(
    tmp_path_factory: pytest.TempPathFactory,
    points_m: list[tuple[float, float, float]],
    facing_rad: float,
    speed_m_s: float,
    start_ns: int,
) -> None:
    path = write_paths(tmp_path_factory.getbasetemp(), AssignedPath(0, points_m, speed_m_s, facing_rad))
    motion = Odometer(path, start_ns).at(start_ns)
    assert (motion.x_m, motion.y_m, motion.yaw_rad) == pytest.approx((0, 0, 0), abs=1e-6)


@given(POINTS, ANGLES, st.floats(0.1, 3))
def test_odometry_is_the_integral_of_the_speed(
    tmp_path_factory: pytest.TempPathFactory,
    points_m: list[tuple[float, float, float]],
    facing_rad: float,
    speed_m_s: float,
) -> None:
    path = write_paths(tmp_path_factory.getbasetemp(), AssignedPath(0, points_m, speed_m_s, facing_rad))
    odometer = Odometer(path, 0)
    path_s = sum(math.dist(*pair) for pair in pairwise(points_m)) / speed_m_s
    steps = 400
    samples = [odometer.at(round((n + 0.5) * path_s * S / steps)) for n in range(steps)]
    x_m = sum(sample.speed_m_s * math.cos(sample.yaw_rad) for sample in samples) * path_s / steps
    y_m = sum(sample.speed_m_s * math.sin(sample.yaw_rad) for sample in samples) * path_s / steps
    end = odometer.at(round(path_s * S) + S)
    tolerance_m = 2 * len(points_m) * speed_m_s * path_s / steps + 1e-6
    assert (end.x_m, end.y_m) == pytest.approx((x_m, y_m), abs=tolerance_m)
    start = points_m[0]
    assert math.hypot(end.x_m, end.y_m) == pytest.approx(math.dist(start[:2], points_m[-1][:2]), abs=1e-6)


@pytest.mark.parametrize("role", [Role.SENDER, Role.RECEIVER])
def test_a_leg_away_is_ahead_and_a_leg_left_is_to_the_left(tmp_path: Path, role: Role) -> None:
    placement = Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("10m"))
    world, move = load_world("lawn"), Move(role, (Leg(away_m=2.0), Leg(left_m=1.0)), 1.0)
    odometer = Odometer(write_paths(tmp_path, places.assigned_path(placement, move, world, 0)), 0)
    end = odometer.at(4 * S)
    assert (end.x_m, end.y_m) == pytest.approx((2.0, 1.0))
    motion = places.motion(CAST, placement, move, world)
    assert end.position_m == pytest.approx(motion.at(4 * S)[CAST[role].name].position_m)


def test_messages_use_the_frames_and_units_of_ros() -> None:
    store, motion = (
        get_typestore(Stores.ROS1_NOETIC),
        RobotMotionState(4.0, 2.0, math.pi / 2, 1.5, (300.0, 400.0, UP_M), math.pi / 2),
    )
    messages: dict[str, Any] = {}
    for kind in ("nav_msgs/Odometry", "sensor_msgs/Imu", "sensor_msgs/NavSatFix"):
        data = Source(Sensor("/x", kind, 10.0, "frame", None)).message(1, 2 * S, motion)
        messages[kind.partition("/")[2]] = store.deserialize_ros1(data, kind.replace("/", "/msg/"))
    odom, imu, fix = (messages[kind] for kind in ("Odometry", "Imu", "NavSatFix"))
    half_sqrt = math.sqrt(0.5)
    assert (odom.pose.pose.position.x, odom.pose.pose.position.y) == (4.0, 2.0)
    assert (odom.child_frame_id, odom.twist.twist.linear.x) == ("base_link", 1.5)
    for orientation in (odom.pose.pose.orientation, imu.orientation):
        assert (orientation.x, orientation.y, orientation.z, orientation.w) == pytest.approx(
            (0, 0, half_sqrt, half_sqrt)
        )
    horizontal_m, vertical_m = FIX_NOISE_M
    variances_m2 = horizontal_m**2, horizontal_m**2, vertical_m**2
    assert fix.position_covariance.tolist() == pytest.approx(np.diag(variances_m2).flatten().tolist())
    assert (fix.latitude, fix.longitude) == pytest.approx((400 / 110_574.28, 300 / 111_319.49), abs=5e-6)
    assert fix.altitude == pytest.approx(UP_M, abs=5 * vertical_m)


def test_noise_of_fixes_agrees_with_their_covariance() -> None:
    source, store = (
        Source(Sensor("/fix", "sensor_msgs/NavSatFix", 10.0, "gps", None)),
        get_typestore(Stores.ROS1_NOETIC),
    )
    fixes: list[Any] = [store.deserialize_ros1(source.message(n, n), "sensor_msgs/msg/NavSatFix") for n in range(500)]
    east_m = [fix.longitude * 111_319.49 for fix in fixes]
    assert math.sqrt(sum(error_m**2 for error_m in east_m) / 500) == pytest.approx(FIX_NOISE_M[0], rel=0.15)
