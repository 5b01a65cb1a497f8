"""Messages of the sensors of every shipped robot, checked against REP 103, 105, 117 and 145, and sensor_msgs."""

import math
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config import locations
from fieldkit.config.profiles import load_profile
from fieldkit.core.model import Leg, Move, Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.ros.interfaces.types import standard_types
from sim_backends.emulated import placement as places
from sim_backends.emulated.provisioning import _sensor
from sim_backends.emulated.ros.assigned_path import append_path
from sim_backends.emulated.ros.messages import GENERATORS, Source
from sim_backends.emulated.ros.robot_motion import AT_REST, Odometer, RobotMotionState
from sim_backends.emulated.ros.sensor_specs import GENERATED_TYPES, LaserTarget, Sensor
from sim_backends.world.motion import GRAVITY_M_S2
from sim_backends.world.world import load_world
from tests.helpers.casts import CAST

S: Final = 10**9
PROFILES: Final = locations.names("robots")
METRES: Final = st.floats(-30, 30)
ANGLES: Final = st.floats(-math.pi, math.pi)
MOTIONS: Final = st.builds(
    RobotMotionState,
    METRES,
    METRES,
    ANGLES,
    st.floats(-2, 2),
    st.tuples(METRES, METRES, st.floats(0, 100)),
    ANGLES,
    ANGLES,
)
STORE: Final = standard_types().ros1


@cache
def sensors_of_profile(name: str) -> dict[str, Sensor]:
    """Return the sensors of a shipped robot by their topics."""
    return {topic.name: _sensor(topic) for topic in load_profile(name).topics}


def sensors(kind: str = "") -> list[Sensor]:
    """Return the sensors of all shipped robots, or those of one type; equal sensors are returned once."""
    result = {
        (sensor.type, sensor.frame, sensor.points): sensor
        for name in PROFILES
        for sensor in sensors_of_profile(name).values()
    }
    assert result
    return [sensor for sensor in result.values() if kind in (sensor.type, "")]


def publish(
    sensor: Sensor, motion: RobotMotionState = AT_REST, *, source: Source | None = None, number: int = 1
) -> Any:  # noqa: ANN401 (of rosbags)
    data = (source or Source(sensor)).message(number, number * S, motion)
    return STORE.deserialize_ros1(data, sensor.type.replace("/", "/msg/"))


def headers(message: Any) -> list[Any]:  # noqa: ANN401 (as above)
    return (
        [transform.header for transform in message.transforms] if hasattr(message, "transforms") else [message.header]
    )


def quaternions(message: Any) -> Iterator[tuple[float, ...]]:  # noqa: ANN401 (as above)
    """Yield every quaternion in a message."""
    for name in getattr(message, "__dataclass_fields__", {}):
        value = getattr(message, name)
        if "Quaternion" in type(value).__name__:
            yield (value.x, value.y, value.z, value.w)
        elif isinstance(value, list):
            for item in value:
                yield from quaternions(item)
        else:
            yield from quaternions(value)


def yaw_rad(quaternion: Any) -> float:  # noqa: ANN401 (as above)
    return 2 * math.atan2(quaternion.z, quaternion.w)


@pytest.mark.parametrize("profile", PROFILES)
def test_every_topic_of_a_shipped_robot_has_a_generator(profile: str) -> None:
    assert {
        sensor.type for sensor in sensors_of_profile(profile).values() if sensor.template is None
    } <= GENERATORS.keys()


def test_the_generated_types_are_those_with_a_generator() -> None:
    assert tuple(GENERATORS) == GENERATED_TYPES


@pytest.mark.parametrize("profile", PROFILES)
def test_every_message_has_a_frame_that_tf2_accepts(profile: str) -> None:
    for topic in load_profile(profile).topics:
        for header in headers(publish(_sensor(topic))):
            assert header.frame_id == topic.frame
            assert not header.frame_id.startswith("/"), "tf2 rejects these"
            # Only a battery has no frame.
            assert header.frame_id or topic.type == "sensor_msgs/BatteryState"


def test_stamps_equal_the_passed_time() -> None:
    for sensor in sensors():
        source = Source(sensor)
        for number in (1, 2):
            (header,) = headers(publish(sensor, source=source, number=number))
            assert (header.stamp.sec, header.stamp.nanosec, header.seq) == (number, 0, number)


@given(MOTIONS)
def test_quaternions_have_length_1(motion: RobotMotionState) -> None:
    for sensor in sensors():
        for quaternion in quaternions(publish(sensor, motion)):
            assert math.hypot(*quaternion) == pytest.approx(1.0)


def test_covariances_are_symmetric_and_positive_definite() -> None:
    matrix_count = 0
    for sensor in sensors():
        message = publish(sensor)
        parts = [message, *(getattr(message, name, None) for name in ("pose", "twist"))]
        for part in parts:
            for name in getattr(part, "__dataclass_fields__", {}):
                if name.endswith("covariance"):
                    size = math.isqrt(len(getattr(part, name)))
                    matrix = getattr(part, name).reshape(size, size)
                    assert (matrix == matrix.T).all()
                    assert (np.diag(matrix) > 0).all(), "0 would mean unknown, -1 not measured"
                    assert (np.linalg.eigvalsh(matrix) > 0).all()
                    matrix_count += 1
    assert matrix_count >= 10


@given(MOTIONS)
def test_a_transform_is_the_pose_of_its_robot_s_odometry(motion: RobotMotionState) -> None:
    """REP 105: odom is the parent, and the robot's base the child; both have the same pose."""
    for name in PROFILES:
        sensors_by_type = {sensor.type: sensor for sensor in sensors_of_profile(name).values()}
        if "nav_msgs/Odometry" not in sensors_by_type:
            assert "tf2_msgs/TFMessage" not in sensors_by_type
            continue
        odom, (transform,) = (
            publish(sensors_by_type["nav_msgs/Odometry"], motion),
            publish(sensors_by_type["tf2_msgs/TFMessage"], motion).transforms,
        )
        assert odom.header.frame_id == transform.header.frame_id == "odom"
        assert odom.child_frame_id == transform.child_frame_id
        assert odom.child_frame_id in {"base_link", "base_footprint", "body"}
        pose, transform_pose = odom.pose.pose, transform.transform
        assert (pose.position.x, pose.position.y, 0.0) == (
            transform_pose.translation.x,
            transform_pose.translation.y,
            pose.position.z,
        )
        assert pose.orientation == transform_pose.rotation
        twist = odom.twist.twist
        assert (twist.linear.x, twist.linear.y) == (motion.speed_m_s, 0.0), "in the robot's frame, which drives ahead"
        assert twist.angular.z == pytest.approx(motion.turn_rad_s, abs=0.01)


@pytest.mark.parametrize("sensor", sensors("sensor_msgs/LaserScan"), ids=lambda sensor: str(sensor.points))
def test_the_angles_and_times_of_a_scan_match_its_number_of_beams(sensor: Sensor) -> None:
    scan = publish(sensor)
    count = len(scan.ranges)
    assert count == len(scan.intensities) == sensor.points
    assert scan.angle_max - scan.angle_min == pytest.approx((count - 1) * scan.angle_increment, rel=1e-5)
    assert count * scan.angle_increment == pytest.approx(2 * math.pi, rel=1e-5)
    assert (scan.scan_time, count * scan.time_increment) == pytest.approx(
        (1 / sensor.rate_hz, 1 / sensor.rate_hz), rel=1e-5
    )


@given(MOTIONS)
def test_ranges_are_within_the_sensor_s_reach_or_infinite(motion: RobotMotionState) -> None:
    """REP 117: minus infinity for too near, infinity for too far."""
    for sensor in sensors("sensor_msgs/LaserScan"):
        scan = publish(sensor, motion)
        samples = scan.ranges[np.isfinite(scan.ranges)]
        assert ((samples >= scan.range_min) & (samples <= scan.range_max)).all()
        assert not np.isnan(scan.ranges).any()
    for sensor in sensors("sensor_msgs/Range"):
        downward = publish(sensor, motion)
        assert math.isinf(downward.range) or downward.min_range <= downward.range <= downward.max_range
        assert 0 < downward.field_of_view < math.pi


def test_ranges_to_walls_follow_position_and_heading() -> None:
    """The ranges depend on the position in the world, and not on the start of the odometry."""
    (sensor, *_) = sensors("sensor_msgs/LaserScan")
    room = LaserTarget(((8.0, 4.0), (12.0, 4.0), (12.0, 7.0), (8.0, 7.0)), 0.0, 0.0, 2.0)
    source = Source(sensor, [room])
    ahead, left = 0, (sensor.points or 0) // 4
    scan_after_drive = publish(
        sensor, RobotMotionState(x_m=70.0, yaw_rad=1.0, position_m=(10.5, 5.5, 0.2)), source=source
    )
    assert scan_after_drive.ranges[ahead] == pytest.approx(1.5, abs=0.1)
    assert scan_after_drive.ranges[left] == pytest.approx(1.5, abs=0.1)
    assert scan_after_drive.ranges[2 * left] == pytest.approx(2.5, abs=0.1)
    scan_after_turn = publish(
        sensor, RobotMotionState(position_m=(10.5, 5.0, 0.2), heading_rad=math.pi / 2), source=source
    )
    assert scan_after_turn.ranges[ahead] == pytest.approx(2.0, abs=0.1)
    assert scan_after_turn.ranges[left] == pytest.approx(2.5, abs=0.1)
    assert (scan_after_drive.intensities > 0).all()


def test_a_beam_without_echo_has_infinite_range_and_no_intensity() -> None:
    (sensor, *_) = sensors("sensor_msgs/LaserScan")
    room = LaserTarget(((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)), 0.0, 0.0, 2.0)
    assert len(Source(sensor).message(1, 2)) == len(Source(sensor, [room]).message(1, 2))
    scan = publish(sensor)
    assert np.isposinf(scan.ranges).all()
    assert not scan.intensities.any()


def test_battery_values_are_plausible_or_nan() -> None:
    for sensor in sensors("sensor_msgs/BatteryState"):
        battery = publish(sensor)
        assert 0 <= battery.percentage <= 1
        assert 3 < battery.voltage < 60
        assert battery.present
        assert battery.power_supply_status == battery.POWER_SUPPLY_STATUS_DISCHARGING
        assert battery.power_supply_health == battery.POWER_SUPPLY_HEALTH_GOOD
        assert battery.power_supply_technology == battery.POWER_SUPPLY_TECHNOLOGY_LIPO
        for unmeasured in (battery.current, battery.charge, battery.capacity, battery.temperature):
            assert math.isnan(unmeasured)


@given(ANGLES)
def test_an_imu_at_rest_measures_only_gravity(heading_rad: float) -> None:
    """REP 145: up is positive, and acceleration includes gravity."""
    for sensor in sensors("sensor_msgs/Imu"):
        imu = publish(sensor, RobotMotionState(heading_rad=heading_rad))
        acceleration = imu.linear_acceleration
        assert (acceleration.x, acceleration.y, acceleration.z) == pytest.approx((0, 0, GRAVITY_M_S2), abs=0.2)
        assert math.remainder(yaw_rad(imu.orientation) - heading_rad, 2 * math.pi) == pytest.approx(0, abs=1e-6)


def test_the_turn_rate_integrates_to_the_heading() -> None:
    (sensor, *_) = sensors("sensor_msgs/Imu")
    source, rate_rad_s, count = Source(sensor), 0.5, round(2 * sensor.rate_hz)
    samples = [
        publish(
            sensor,
            RobotMotionState(heading_rad=rate_rad_s * number / sensor.rate_hz, turn_rad_s=rate_rad_s),
            source=source,
        )
        for number in range(count + 1)
    ]
    integrated_rad = sum(imu.angular_velocity.z for imu in samples[:-1]) / sensor.rate_hz
    assert yaw_rad(samples[-1].orientation) - yaw_rad(samples[0].orientation) == pytest.approx(
        integrated_rad, abs=0.01
    )


@given(MOTIONS)
def test_heights_are_those_of_the_robot(motion: RobotMotionState) -> None:
    for sensor in sensors("sensor_msgs/NavSatFix"):
        assert publish(sensor, motion).altitude == pytest.approx(motion.position_m[2], abs=5)
    for sensor in sensors("geometry_msgs/PoseStamped"):
        pose = publish(sensor, motion).pose
        assert (pose.position.x, pose.position.y, pose.position.z) == motion.position_m
        assert math.remainder(yaw_rad(pose.orientation) - motion.heading_rad, 2 * math.pi) == pytest.approx(
            0, abs=1e-6
        )
    for sensor in sensors("sensor_msgs/Range"):
        down_m = publish(sensor, motion).range
        assert down_m == pytest.approx(max(0.1, motion.position_m[2]), abs=0.1) or (
            motion.position_m[2] > 3.8 and down_m > 3.8
        )
    pressure = publish(Sensor("/p", "sensor_msgs/FluidPressure", 1.0, "base_link", None), motion)
    # 11.3 to 12.0 Pa less per metre below 600 m (ISO 2533).
    pressure_drop_pa = 101_325 - pressure.fluid_pressure
    assert 11.3 * motion.position_m[2] - 20 < pressure_drop_pa < 12.02 * motion.position_m[2] + 20


@given(ANGLES)
def test_the_magnetic_field_points_north_for_any_heading(heading_rad: float) -> None:
    sensor = Sensor("/mag", "sensor_msgs/MagneticField", 1.0, "imu_link", None)
    field = publish(sensor, RobotMotionState(heading_rad=heading_rad)).magnetic_field
    direction_rad = math.atan2(field.y, field.x) + heading_rad
    assert math.remainder(direction_rad - math.pi / 2, 2 * math.pi) == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("sensor", sensors("nav_msgs/Odometry"), ids=lambda sensor: sensor.topic)
def test_the_speed_of_odometry_integrates_to_its_pose_and_to_the_path(sensor: Sensor, tmp_path: Path) -> None:
    placement = Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("10m"))
    world, move = load_world("lawn"), Move(Role.SENDER, (Leg(away_m=2.0), Leg(left_m=1.0), Leg(away_m=1.0)), 0.5)
    append_path(tmp_path / "motion", places.assigned_path(placement, move, world, 0))
    odometer, source = Odometer(tmp_path / "motion", 0), Source(sensor)
    period_s, path_s = 1 / sensor.rate_hz, 8.0
    samples = [
        publish(sensor, odometer.at(round(n * period_s * S)), source=source)
        for n in range(round(10 * sensor.rate_hz))
    ]
    x_m = y_m = 0.0
    for before, after in pairwise(samples):
        direction_rad = yaw_rad(before.pose.pose.orientation)
        x_m += before.twist.twist.linear.x * math.cos(direction_rad) * period_s
        y_m += before.twist.twist.linear.x * math.sin(direction_rad) * period_s
        # The error is at most the motion of the last period of each leg.
        assert (after.pose.pose.position.x, after.pose.pose.position.y) == pytest.approx(
            (x_m, y_m), abs=3 * 0.5 * period_s
        )
    world_motion = places.motion(CAST, placement, move, world)
    start, end = (world_motion.at(round(t_s * S))[CAST[Role.SENDER].name].position_m for t_s in (0.0, path_s + 1))
    assert math.hypot(x_m, y_m) == pytest.approx(math.dist(start[:2], end[:2]), abs=3 * 0.5 * period_s)
    assert (samples[-1].pose.pose.position.x, samples[-1].pose.pose.position.y) == pytest.approx((3.0, 1.0))
