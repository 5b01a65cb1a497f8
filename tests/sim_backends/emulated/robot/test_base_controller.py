"""The base controller: limits, odometry as the integral of the speed, and the stop without velocities."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from sim_backends.emulated.robot import base_process
from sim_backends.emulated.robot.base_controller import STEP_NS, TIMEOUT_NS, BaseController
from sim_backends.emulated.robot.spec import Base
from sim_backends.emulated.ros.robot_motion import RobotMotionState

S = 10**9
BASE = Base("/cmd_vel", "geometry_msgs/Twist", 0.5, 1.0, 2.0)
ANY = st.floats(allow_nan=True, allow_infinity=True)
START = RobotMotionState(x_m=1.0, y_m=2.0, yaw_rad=0.5, position_m=(30.0, 40.0, 0.2), heading_rad=-1.0)


@given(st.lists(st.tuples(st.integers(0, S), st.one_of(st.floats(-2, 2), ANY), st.one_of(st.floats(-9, 9), ANY))))
def test_any_velocities_stay_within_limits_and_odometry_follows(
    commands: list[tuple[int, float, float]],
) -> None:
    controller, now_ns = BaseController(BASE, 0), 0
    controller.reset(START)
    x_m, y_m, yaw_rad = START.x_m, START.y_m, START.yaw_rad
    for interval_ns, forward_m_s, turn_rad_s in commands:
        now_ns += interval_ns
        controller.advance(now_ns)
        controller.set_velocity(now_ns, forward_m_s, turn_rad_s)
        for _ in range(20):
            before, (x0, y0, yaw0) = controller.pose, controller.odometry
            now_ns += STEP_NS
            controller.advance(now_ns)
            after, (x_m, y_m, yaw_rad) = controller.pose, controller.odometry
            assert abs(after.speed_m_s) <= BASE.speed_m_s + 1e-9
            assert abs(after.turn_rad_s) <= BASE.turn_rad_s + 1e-9
            assert abs(after.speed_m_s - before.speed_m_s) <= BASE.acceleration_m_s2 * 2 * STEP_NS / S + 1e-9
            forward_m = math.hypot(x_m - x0, y_m - y0)
            assert forward_m == pytest.approx(math.dist(after.place_m, before.place_m), abs=1e-9)
            # Odometry and world show the same change of heading.
            assert yaw_rad - yaw0 == pytest.approx(after.heading_rad - before.heading_rad, abs=1e-9)
    assert yaw_rad - START.yaw_rad == pytest.approx(controller.pose.heading_rad - START.heading_rad, abs=1e-6)


def test_the_robot_drives_while_velocities_arrive_and_then_stops() -> None:
    controller = BaseController(BASE, 0)
    controller.reset(START)
    assert controller.is_idle
    for now_ns in range(10 * S, 12 * S, S // 10):
        controller.set_velocity(now_ns, 0.4, 0.0)
        controller.advance(now_ns)
    assert controller.pose.speed_m_s == pytest.approx(0.4)
    last_ns = 12 * S - S // 10
    controller.advance(last_ns + TIMEOUT_NS)
    assert controller.pose.speed_m_s == pytest.approx(0.4), "before the timeout"
    controller.advance(last_ns + TIMEOUT_NS + S // 2)
    assert controller.is_idle
    stop_place_m = controller.pose.place_m
    controller.advance(100 * S)
    assert controller.pose.place_m == stop_place_m
    # Deceleration takes as long as acceleration.
    distance_m = 0.4 * (1.9 + TIMEOUT_NS / S)
    assert math.dist(stop_place_m, START.position_m) == pytest.approx(distance_m, abs=0.02)
    course_rad = math.atan2(stop_place_m[1] - START.position_m[1], stop_place_m[0] - START.position_m[0])
    assert course_rad == pytest.approx(START.heading_rad)
    x_m, y_m, _ = controller.odometry
    assert math.atan2(y_m - START.y_m, x_m - START.x_m) == pytest.approx(START.yaw_rad)


def test_a_reset_robot_is_at_rest_at_the_new_place() -> None:
    controller = BaseController(BASE, 0)
    controller.set_velocity(0, 0.5, 0.0)
    controller.advance(S // 2)
    assert not controller.is_idle
    controller.reset(START)
    assert controller.is_idle
    assert (controller.pose.place_m, controller.odometry) == (START.position_m, (START.x_m, START.y_m, START.yaw_rad))


def test_velocities_are_packed_exactly_and_other_datagrams_are_ignored() -> None:
    message_types = get_typestore(Stores.ROS1_NOETIC).types
    vector = message_types["geometry_msgs/msg/Vector3"]
    twist = message_types["geometry_msgs/msg/Twist"](vector(0.25, 1.0, 2.0), vector(3.0, 4.0, -0.5))
    assert base_process.unpack(base_process.pack(twist)) == (0.25, -0.5)
    assert base_process.unpack(b"") is None
    assert base_process.unpack(bytes(base_process.BYTES + 1)) is None


@pytest.mark.parametrize(
    ("stamp_ns", "is_outdated"),
    [(0, False), (9 * S, True), (int(9.5 * S), True), (int(9.5 * S) + 1, False), (11 * S, False)],
)
def test_a_stamped_velocity_is_outdated_half_a_second_after_its_stamp(stamp_ns: int, is_outdated: bool) -> None:
    assert base_process.is_outdated(stamp_ns, 10 * S) is is_outdated
