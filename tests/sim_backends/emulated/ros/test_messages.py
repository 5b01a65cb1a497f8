"""What the sensors of every shipped robot say, rule by rule: of REP 103, 105, 117 and 145, and of sensor_msgs."""

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
from fieldkit.ros.types import shipped
from sim_backends.emulated import placement as places
from sim_backends.emulated.provisioning import _sensor
from sim_backends.emulated.ros import own_motion
from sim_backends.emulated.ros.laser import LaserTarget
from sim_backends.emulated.ros.messages import GENERATORS, GRAVITY_M_S2, Sensor, Source
from sim_backends.emulated.ros.own_motion import AT_REST, Odometer, OwnMotion
from sim_backends.world.world import load_world
from tests.helpers.casts import CAST, ros_of

S: Final = 10**9
PROFILES: Final = locations.names("robots")
METRES: Final = st.floats(-30, 30)
ANGLES: Final = st.floats(-math.pi, math.pi)
MOTIONS: Final = st.builds(
    OwnMotion, METRES, METRES, ANGLES, st.floats(-2, 2), st.tuples(METRES, METRES, st.floats(0, 100)), ANGLES, ANGLES
)
STORE: Final = shipped().ros1


@cache
def of_profile(name: str) -> dict[str, Sensor]:
    """Return what a shipped robot publishes by its topic."""
    return {topic.name: _sensor(topic) for topic in ros_of(load_profile(name)).topics}


def sensors(kind: str = "") -> list[Sensor]:
    """Return what all shipped robots publish, or that of a type."""
    found = [one for name in PROFILES for one in of_profile(name).values()]
    assert found
    return [one for one in found if kind in (one.type, "")]


def said(one: Sensor, now: OwnMotion = AT_REST, *, source: Source | None = None, number: int = 1) -> Any:  # noqa: ANN401 (of rosbags)
    data = (source or Source(one)).message(number, number * S, now)
    return STORE.deserialize_ros1(data, one.type.replace("/", "/msg/"))


def headers(message: Any) -> list[Any]:  # noqa: ANN401 (as above)
    return [one.header for one in message.transforms] if hasattr(message, "transforms") else [message.header]


def quaternions(message: Any) -> Iterator[tuple[float, ...]]:  # noqa: ANN401 (as above)
    """Yield every quaternion in a message."""
    for name in getattr(message, "__dataclass_fields__", {}):
        value = getattr(message, name)
        if "Quaternion" in type(value).__name__:
            yield (value.x, value.y, value.z, value.w)
        elif isinstance(value, list):
            for one in value:
                yield from quaternions(one)
        else:
            yield from quaternions(value)


def yaw_rad(quaternion: Any) -> float:  # noqa: ANN401 (as above)
    return 2 * math.atan2(quaternion.z, quaternion.w)


@pytest.mark.parametrize("profile", PROFILES)
def test_all_that_robots_measure_has_a_generator(profile: str) -> None:
    assert {one.type for one in ros_of(load_profile(profile)).topics} <= GENERATORS.keys()


@pytest.mark.parametrize("profile", PROFILES)
def test_every_place_has_a_frame_that_tf2_takes(profile: str) -> None:
    for topic in ros_of(load_profile(profile)).topics:
        for header in headers(said(_sensor(topic))):
            assert header.frame_id == topic.frame
            assert not header.frame_id.startswith("/"), "tf2 refuses those"
            # A battery is nowhere.
            assert header.frame_id or topic.type == "sensor_msgs/BatteryState"


def test_stamps_are_those_of_the_clock() -> None:
    for one in sensors():
        source = Source(one)
        for number in (1, 2):
            (header,) = headers(said(one, source=source, number=number))
            assert (header.stamp.sec, header.stamp.nanosec, header.seq) == (number, 0, number)


@given(MOTIONS)
def test_quaternions_are_of_length_1(now: OwnMotion) -> None:
    for one in sensors():
        for found in quaternions(said(one, now)):
            assert math.hypot(*found) == pytest.approx(1.0)


def test_covariances_are_symmetric_and_of_no_negative_variance() -> None:
    checked = 0
    for one in sensors():
        message = said(one)
        holders = [message, *(getattr(message, name, None) for name in ("pose", "twist"))]
        for holder in holders:
            for name in getattr(holder, "__dataclass_fields__", {}):
                if name.endswith("covariance"):
                    size = math.isqrt(len(getattr(holder, name)))
                    matrix = getattr(holder, name).reshape(size, size)
                    assert (matrix == matrix.T).all()
                    assert (np.diag(matrix) > 0).all(), "0 is unknown, -1 there is none: these robots measure"
                    assert (np.linalg.eigvalsh(matrix) > 0).all()
                    checked += 1
    assert checked >= 10


@given(MOTIONS)
def test_a_transform_is_the_pose_of_its_robot_s_odometry(now: OwnMotion) -> None:
    """REP 105: odom is the parent, and the robot's base the child; both say the same."""
    for name in PROFILES:
        own = {one.type: one for one in of_profile(name).values()}
        if "nav_msgs/Odometry" not in own:
            assert "tf2_msgs/TFMessage" not in own
            continue
        odom, (transform,) = (said(own["nav_msgs/Odometry"], now), said(own["tf2_msgs/TFMessage"], now).transforms)
        assert odom.header.frame_id == transform.header.frame_id == "odom"
        assert odom.child_frame_id == transform.child_frame_id
        assert odom.child_frame_id in {"base_link", "base_footprint"}
        pose, moved = odom.pose.pose, transform.transform
        assert (pose.position.x, pose.position.y, 0.0) == (moved.translation.x, moved.translation.y, pose.position.z)
        assert pose.orientation == moved.rotation
        twist = odom.twist.twist
        assert (twist.linear.x, twist.linear.y) == (now.speed_m_s, 0.0), "in the robot's frame, which drives ahead"
        assert twist.angular.z == pytest.approx(now.turn_rad_s, abs=0.01)


@pytest.mark.parametrize("one", sensors("sensor_msgs/LaserScan"), ids=lambda one: str(one.points))
def test_a_scan_s_angles_and_times_fit_its_number_of_beams(one: Sensor) -> None:
    scan = said(one)
    count = len(scan.ranges)
    assert count == len(scan.intensities) == one.points
    assert scan.angle_max - scan.angle_min == pytest.approx((count - 1) * scan.angle_increment, rel=1e-5)
    assert count * scan.angle_increment == pytest.approx(2 * math.pi, rel=1e-5)
    assert (scan.scan_time, count * scan.time_increment) == pytest.approx(
        (1 / one.rate_hz, 1 / one.rate_hz), rel=1e-5
    )


@given(MOTIONS)
def test_ranges_are_within_the_sensor_s_reach_or_infinite(now: OwnMotion) -> None:
    """REP 117: minus infinity for too near, infinity for too far."""
    for one in sensors("sensor_msgs/LaserScan"):
        scan = said(one, now)
        told = scan.ranges[np.isfinite(scan.ranges)]
        assert ((told >= scan.range_min) & (told <= scan.range_max)).all()
        assert not np.isnan(scan.ranges).any()
    for one in sensors("sensor_msgs/Range"):
        down = said(one, now)
        assert math.isinf(down.range) or down.min_range <= down.range <= down.max_range
        assert 0 < down.field_of_view < math.pi


def test_walls_come_nearer_and_turn_as_the_robot_drives_and_turns() -> None:
    """By its place in the world, wherever its odometry began to count."""
    (one, *_) = sensors("sensor_msgs/LaserScan")
    room = LaserTarget(((8.0, 4.0), (12.0, 4.0), (12.0, 7.0), (8.0, 7.0)), 0.0, 0.0, 2.0)
    source = Source(one, [room])
    ahead, left = 0, (one.points or 0) // 4
    driven = said(one, OwnMotion(x_m=70.0, yaw_rad=1.0, place_m=(10.5, 5.5, 0.2)), source=source)
    assert driven.ranges[ahead] == pytest.approx(1.5, abs=0.1)
    assert driven.ranges[left] == pytest.approx(1.5, abs=0.1)
    assert driven.ranges[2 * left] == pytest.approx(2.5, abs=0.1)
    turned = said(one, OwnMotion(place_m=(10.5, 5.0, 0.2), heading_rad=math.pi / 2), source=source)
    assert turned.ranges[ahead] == pytest.approx(2.0, abs=0.1)
    assert turned.ranges[left] == pytest.approx(2.5, abs=0.1)
    assert (driven.intensities > 0).all()


def test_no_echo_is_infinitely_far_and_of_no_intensity_in_as_many_bytes() -> None:
    (one, *_) = sensors("sensor_msgs/LaserScan")
    room = LaserTarget(((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)), 0.0, 0.0, 2.0)
    assert len(Source(one).message(1, 2)) == len(Source(one, [room]).message(1, 2))
    scan = said(one)
    assert np.isposinf(scan.ranges).all()
    assert not scan.intensities.any()


def test_batteries_are_shares_volts_and_ampere_hours_or_not_a_number() -> None:
    for one in sensors("sensor_msgs/BatteryState"):
        battery = said(one)
        assert 0 <= battery.percentage <= 1
        assert 3 < battery.voltage < 60
        assert battery.present
        assert battery.power_supply_status == battery.POWER_SUPPLY_STATUS_DISCHARGING
        assert battery.power_supply_health == battery.POWER_SUPPLY_HEALTH_GOOD
        assert battery.power_supply_technology == battery.POWER_SUPPLY_TECHNOLOGY_LIPO
        for unmeasured in (battery.current, battery.charge, battery.capacity, battery.temperature):
            assert math.isnan(unmeasured)


@given(ANGLES)
def test_an_imu_that_stands_feels_gravity_alone_and_faces_from_east_to_north(heading_rad: float) -> None:
    """REP 145: what is up is positive, and acceleration has gravity in it."""
    for one in sensors("sensor_msgs/Imu"):
        imu = said(one, OwnMotion(heading_rad=heading_rad))
        felt = imu.linear_acceleration
        assert (felt.x, felt.y, felt.z) == pytest.approx((0, 0, GRAVITY_M_S2), abs=0.2)
        assert math.remainder(yaw_rad(imu.orientation) - heading_rad, 2 * math.pi) == pytest.approx(0, abs=1e-6)


def test_a_gyroscope_s_turning_adds_up_to_the_heading() -> None:
    (one, *_) = sensors("sensor_msgs/Imu")
    source, rate_rad_s, count = Source(one), 0.5, round(2 * one.rate_hz)
    told = [
        said(one, OwnMotion(heading_rad=rate_rad_s * number / one.rate_hz, turn_rad_s=rate_rad_s), source=source)
        for number in range(count + 1)
    ]
    turned_rad = sum(imu.angular_velocity.z for imu in told[:-1]) / one.rate_hz
    assert yaw_rad(told[-1].orientation) - yaw_rad(told[0].orientation) == pytest.approx(turned_rad, abs=0.01)


@given(MOTIONS)
def test_heights_are_of_the_robot(now: OwnMotion) -> None:
    for one in sensors("sensor_msgs/NavSatFix"):
        assert said(one, now).altitude == pytest.approx(now.place_m[2], abs=5)
    for one in sensors("geometry_msgs/PoseStamped"):
        pose = said(one, now).pose
        assert (pose.position.x, pose.position.y, pose.position.z) == now.place_m
        assert math.remainder(yaw_rad(pose.orientation) - now.heading_rad, 2 * math.pi) == pytest.approx(0, abs=1e-6)
    for one in sensors("sensor_msgs/Range"):
        down_m = said(one, now).range
        assert down_m == pytest.approx(max(0.1, now.place_m[2]), abs=0.1) or (now.place_m[2] > 3.8 and down_m > 3.8)
    pressure = said(Sensor("/p", "sensor_msgs/FluidPressure", 1.0, "base_link", None), now)
    # 11.3 to 12.0 Pa less per metre below 600 m (ISO 2533).
    fallen_pa = 101_325 - pressure.fluid_pressure
    assert 11.3 * now.place_m[2] - 20 < fallen_pa < 12.02 * now.place_m[2] + 20


@given(ANGLES)
def test_the_magnetic_field_points_north_whatever_the_robot_faces(heading_rad: float) -> None:
    one = Sensor("/mag", "sensor_msgs/MagneticField", 1.0, "imu_link", None)
    field = said(one, OwnMotion(heading_rad=heading_rad)).magnetic_field
    towards_rad = math.atan2(field.y, field.x) + heading_rad
    assert math.remainder(towards_rad - math.pi / 2, 2 * math.pi) == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("one", sensors("nav_msgs/Odometry"), ids=lambda one: one.topic)
def test_odometry_s_speeds_add_up_to_its_pose_and_to_the_way_through_the_world(one: Sensor, tmp_path: Path) -> None:
    placement = Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("10m"))
    world, move = load_world("lawn"), Move(Role.SENDER, (Leg(away_m=2.0), Leg(left_m=1.0), Leg(away_m=1.0)), 0.5)
    own_motion.append_path(tmp_path / "motion", places.assigned_path(placement, move, world, 0))
    odometer, source = Odometer(tmp_path / "motion", 0), Source(one)
    period_s, long_s = 1 / one.rate_hz, 8.0
    told = [said(one, odometer.at(round(n * period_s * S)), source=source) for n in range(round(10 * one.rate_hz))]
    x_m = y_m = 0.0
    for before, after in pairwise(told):
        towards_rad = yaw_rad(before.pose.pose.orientation)
        x_m += before.twist.twist.linear.x * math.cos(towards_rad) * period_s
        y_m += before.twist.twist.linear.x * math.sin(towards_rad) * period_s
        # Off by less than what a leg's last period has too much of, for each leg.
        assert (after.pose.pose.position.x, after.pose.pose.position.y) == pytest.approx(
            (x_m, y_m), abs=3 * 0.5 * period_s
        )
    motion = places.motion(CAST, placement, move, world)
    begin, end = (motion.at(round(t_s * S))[CAST[Role.SENDER].name].position_m for t_s in (0.0, long_s + 1))
    assert math.hypot(x_m, y_m) == pytest.approx(math.dist(begin[:2], end[:2]), abs=3 * 0.5 * period_s)
    assert (told[-1].pose.pose.position.x, told[-1].pose.pose.position.y) == pytest.approx((3.0, 1.0))
