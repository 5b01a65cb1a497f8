"""The laser of a robot, and the positions of other robots that its beams may hit."""

import math
import os
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config.profiles import load_profile
from fieldkit.core.model import Vector
from fieldkit.ros.interfaces.types import standard_types
from sim_backends.emulated.provisioning import laser_targets, neighbour
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.lab_positions import Neighbourhood, PositionsWriter
from sim_backends.emulated.ros.laser import ranges_m
from sim_backends.emulated.ros.messages import LASER_NOISE_M, Source
from sim_backends.emulated.ros.robot_motion import RobotMotionState
from sim_backends.emulated.ros.sensor_specs import LASER_SCAN, LaserTarget, Neighbour, Sensor
from sim_backends.world.penetration import Solids
from sim_backends.world.shapes import Box, Cylinder
from sim_backends.world.world import World, load_world

BEAMS = 360
REACH_M = 100.0
ROOM = LaserTarget(((0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)), 0.0, 0.0, 2.0)
"""From inside, its edges are the walls of a room."""


def scan(*targets: LaserTarget, east_m: float, north_m: float, heading_rad: float = 0.0) -> list[float]:
    return ranges_m(targets, (east_m, north_m, 0.2), heading_rad, BEAMS, REACH_M)


def test_the_range_to_a_wall_ahead_is_its_distance_divided_by_the_cosine() -> None:
    wall = LaserTarget(((5.0, -1.0), (5.2, -1.0), (5.2, 1.0), (5.0, 1.0)), 0.0, 0.0, 2.0)
    ranges = scan(wall, east_m=2.0, north_m=0.0)
    half_angle_deg = math.degrees(math.atan2(1.0, 3.0))  # 18.4 degrees to either side
    for beam, range_m in enumerate(ranges):
        angle = (beam + 180) % 360 - 180
        expected_m = 3.0 / math.cos(math.radians(angle)) if abs(angle) <= half_angle_deg else math.inf
        assert range_m == pytest.approx(expected_m), angle


@given(st.floats(0.2, 5.8), st.floats(0.2, 3.8), st.floats(-10, 10))
def test_ranges_in_a_rectangular_room_agree_with_trigonometry(
    east_m: float, north_m: float, heading_rad: float
) -> None:
    angles = heading_rad + np.arange(BEAMS) * math.radians(1)
    with np.errstate(divide="ignore", over="ignore"):
        across_m = np.where(np.cos(angles) > 0, (6.0 - east_m) / np.cos(angles), -east_m / np.cos(angles))
        along_m = np.where(np.sin(angles) >= 0, (4.0 - north_m) / np.sin(angles), -north_m / np.sin(angles))
    ranges = scan(ROOM, east_m=east_m, north_m=north_m, heading_rad=heading_rad)
    np.testing.assert_allclose(ranges, np.minimum(across_m, along_m), rtol=1e-6)


def test_a_trunk_is_nearest_in_the_middle_and_ends_at_its_tangents() -> None:
    trunk = LaserTarget(((0.0, 3.0),), 0.5, 0.0, 2.0)
    ranges = scan(trunk, east_m=0.0, north_m=0.0)
    assert ranges[90] == pytest.approx(2.5)
    hit_beams = [beam for beam, range_m in enumerate(ranges) if math.isfinite(range_m)]
    half_width_deg = math.floor(math.degrees(math.asin(0.5 / 3.0)))
    assert hit_beams == list(range(90 - half_width_deg, 90 + half_width_deg + 1))


def test_only_solids_at_the_height_of_the_laser_stop_a_beam() -> None:
    crown = LaserTarget(((0.0, 3.0),), 2.0, 1.0, 4.0)
    step = LaserTarget(((1.0, -1.0), (2.0, -1.0), (2.0, 1.0), (1.0, 1.0)), 0.0, 0.0, 0.1)
    assert set(scan(crown, step, east_m=0.0, north_m=0.0)) == {math.inf}


def test_surfaces_out_of_reach_are_infinite_and_the_nearer_one_hides_the_other() -> None:
    near_target = LaserTarget(((2.0, -9.0), (2.0, 9.0), (2.1, 0.0)), 0.0, 0.0, 2.0)
    far_target = LaserTarget(((3.0, -9.0), (3.0, 9.0), (3.1, 0.0)), 0.0, 0.0, 2.0)
    assert ranges_m([far_target, near_target], (0.0, 0.0, 0.2), 0.0, BEAMS, 3.5)[0] == pytest.approx(2.0)
    assert ranges_m([far_target], (0.0, 0.0, 0.2), 0.0, BEAMS, 2.5)[0] == math.inf


@pytest.mark.parametrize("name", ["lawn", "baylands"])
def test_beams_end_at_the_points_where_radio_paths_enter_a_solid(name: str) -> None:
    """By an independent calculation, a beam is outside all solids before its end, and inside one just behind it."""
    world: World = load_world(name)
    solids = Solids([part.shape for part in world.parts])
    targets = laser_targets(world)
    rng = np.random.default_rng(1)
    hit_count = missed_count = 0
    centres_m = [part.shape.centre_m[:2] for part in world.parts for _ in range(max(1, 40 // len(world.parts)))]
    for east_m, north_m in (np.array(centres_m) + rng.normal(0, 6, (len(centres_m), 2))).tolist():
        start = np.tile((east_m, north_m, 0.2), (BEAMS, 1))
        if solids.depths_m(start[:1], np.add(start[:1], (0, 0, 1e-6))).any():
            continue  # in a solid
        ranges = np.array(ranges_m(targets, (east_m, north_m, 0.2), 0.3, BEAMS, 20.0))
        angles = 0.3 + np.arange(BEAMS) * math.radians(1)
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEAMS)], axis=1)
        points_before_ends = start + directions * (np.minimum(ranges, 20.0) - 1e-3)[:, None]
        assert solids.depths_m(start, points_before_ends).max() < 1e-2, "only beams that graze a corner or a trunk"
        is_hit = np.isfinite(ranges)
        hit_count += int(is_hit.sum())
        points_behind_ends = start + directions * (np.where(is_hit, ranges, 0.0) + 1e-3)[:, None]
        depths_m = solids.depths_m(start, points_behind_ends).sum(axis=1)[is_hit]
        missed_count += int((depths_m <= 1e-6).sum())
    assert hit_count > 100
    assert missed_count < 0.01 * hit_count, "only beams that touch a corner"


def test_targets_have_the_heights_of_their_shapes() -> None:
    world = load_world("lawn")
    (wall,) = laser_targets(world)
    (part,) = world.parts
    assert isinstance(part.shape, Box)
    assert (wall.base_m, wall.top_m, wall.radius_m) == pytest.approx((0.0, 2.4, 0.0))
    trees = [target for target in laser_targets(load_world("baylands")) if target.radius_m]
    assert len(trees) == sum(isinstance(part.shape, Cylinder) for part in load_world("baylands").parts)


NAMES = ("own", "other", "third")
FLOATS = st.floats(-1e3, 1e3)
PLACES = st.dictionaries(st.sampled_from(NAMES), st.tuples(FLOATS, FLOATS, FLOATS))
BODIES = [Neighbour(number, 0.1, 0.2, 0.3) for number in range(len(NAMES))]
BURGER_RADIUS_M = 0.113
"""Half the diagonal of 138 x 178 mm (ROBOTIS e-Manual, TurtleBot3 Burger)."""


@pytest.fixture
def writer() -> Iterator[PositionsWriter]:
    with closing(PositionsWriter(NAMES)) as places:
        yield places


def expected_targets(places_m: dict[str, Vector]) -> list[LaserTarget]:
    positions = [places_m[name] for name in NAMES if name in places_m]
    return [LaserTarget(((east, north),), 0.1, up - 0.2, up + 0.3) for east, north, up in positions]


@given(st.lists(PLACES, max_size=4))
def test_a_reader_returns_the_places_written_last(writes: list[dict[str, Vector]]) -> None:
    with closing(PositionsWriter(NAMES)) as writer:
        reader = Neighbourhood(writer.fd, len(NAMES))
        assert reader.targets(BODIES) == []
        for places_m in writes:
            writer.write(places_m)
            assert reader.targets(BODIES) == expected_targets(places_m)
        later_reader = Neighbourhood(writer.fd, len(NAMES))
        assert later_reader.targets(BODIES) == (expected_targets(writes[-1]) if writes else [])


def test_a_partly_written_slot_is_ignored(writer: PositionsWriter) -> None:
    first_places_m: dict[str, Vector] = {"other": (1.0, 2.0, 3.0)}
    writer.write(first_places_m)
    old_bytes = os.pread(writer.fd, 1 << 10, 0)
    writer.write({"other": (4.0, 5.0, 6.0)})
    new_bytes = os.pread(writer.fd, 1 << 10, 0)
    different_indices = [index for index in range(len(old_bytes)) if old_bytes[index] != new_bytes[index]]
    for end in different_indices[1:]:  # all of these bytes except the first may be missing
        os.pwrite(writer.fd, new_bytes[:end] + old_bytes[end:], 0)
        assert Neighbourhood(writer.fd, len(NAMES)).targets(BODIES) == expected_targets(first_places_m)


def test_memory_for_fewer_robots_is_refused(writer: PositionsWriter) -> None:
    with pytest.raises(ValueError, match="greater than file size"):
        Neighbourhood(writer.fd, 200)


def test_the_range_to_a_robot_is_its_distance_less_its_radius(writer: PositionsWriter) -> None:
    neighbourhood = Neighbourhood(writer.fd, len(NAMES))
    bodies = [neighbour(1, load_profile("turtlebot3_burger"))]
    scanner = Sensor("/scan", LASER_SCAN, 5.0, "base_scan", 360)
    source = Source(scanner, (), lambda: neighbourhood.targets(bodies))
    robot_motion = RobotMotionState(position_m=(10.0, 20.0, 5.0 + ANTENNA_M), heading_rad=math.pi / 2)

    def scan(**places_m: Vector) -> np.ndarray:
        writer.write(places_m)
        data = source.message(0, 0, robot_motion)
        message: Any = standard_types().ros1.deserialize_ros1(data, "sensor_msgs/msg/LaserScan")
        return np.asarray(message.ranges)

    for distance_m in (2.0, 3.0, 1.0):
        ranges = scan(own=robot_motion.position_m, other=(10.0, 20.0 + distance_m, 5.0 + ANTENNA_M))
        assert ranges[0] == pytest.approx(distance_m - BURGER_RADIUS_M, abs=6 * LASER_NOISE_M)
        half_width_deg = math.floor(math.degrees(math.asin(BURGER_RADIUS_M / distance_m)))
        assert np.isfinite(ranges).nonzero()[0].tolist() == [
            *range(half_width_deg + 1),
            *range(360 - half_width_deg, 360),
        ]
    to_the_right = scan(other=(12.0, 20.0, 5.0 + ANTENNA_M))
    assert to_the_right[270] == pytest.approx(2.0 - BURGER_RADIUS_M, abs=6 * LASER_NOISE_M)
    assert to_the_right[0] == math.inf
    assert np.isinf(scan(other=(10.0, 22.0, 6.0 + ANTENNA_M))).all(), "the robot flies above the beams"
    assert np.isinf(scan(other=(10.0, 24.0, 5.0 + ANTENNA_M))).all(), "the robot is beyond 3.5 m"
    assert np.isinf(scan()).all(), "the robot is not in the world"


@pytest.mark.parametrize(
    ("profile", "radius_m", "above_m"),
    [("turtlebot3_burger", 0.113, 0.0), ("husky", 0.6, 0.19), ("duckiedrone", 0.2, 0.0), ("iris", 0.384, 0.0)],
)
def test_a_body_extends_from_the_ground_to_its_antenna_or_higher(
    profile: str, radius_m: float, above_m: float
) -> None:
    body = neighbour(3, load_profile(profile))
    assert (body.number, body.radius_m, body.below_m) == (3, radius_m, ANTENNA_M)
    assert body.above_m == pytest.approx(above_m)
