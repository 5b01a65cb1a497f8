"""Other robots in the beams of a laser: their positions in shared memory, and the range to an upright cylinder."""

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
from fieldkit.ros.types import shipped
from sim_backends.emulated.provisioning import neighbour
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.laser import LaserTarget, Neighbour, Neighbourhood, PlacesWriter
from sim_backends.emulated.ros.messages import LASER_NOISE_M, LASER_SCAN, Sensor, Source
from sim_backends.emulated.ros.own_motion import OwnMotion

NAMES = ("own", "other", "third")
FLOATS = st.floats(-1e3, 1e3)
PLACES = st.dictionaries(st.sampled_from(NAMES), st.tuples(FLOATS, FLOATS, FLOATS))
BODIES = [Neighbour(number, 0.1, 0.2, 0.3) for number in range(len(NAMES))]
BURGER_RADIUS_M = 0.113
"""Half the diagonal of 138 x 178 mm (ROBOTIS e-Manual, TurtleBot3 Burger)."""


@pytest.fixture
def writer() -> Iterator[PlacesWriter]:
    with closing(PlacesWriter(NAMES)) as places:
        yield places


def expected(places_m: dict[str, Vector]) -> list[LaserTarget]:
    positions = [places_m[name] for name in NAMES if name in places_m]
    return [LaserTarget(((east, north),), 0.1, up - 0.2, up + 0.3) for east, north, up in positions]


@given(st.lists(PLACES, max_size=4))
def test_a_reader_gets_the_places_written_last(written: list[dict[str, Vector]]) -> None:
    with closing(PlacesWriter(NAMES)) as writer:
        reader = Neighbourhood(writer.fd, len(NAMES))
        assert reader.targets(BODIES) == []
        for places_m in written:
            writer.write(places_m)
            assert reader.targets(BODIES) == expected(places_m)
        late = Neighbourhood(writer.fd, len(NAMES))
        assert late.targets(BODIES) == (expected(written[-1]) if written else [])


def test_a_partly_written_slot_is_ignored(writer: PlacesWriter) -> None:
    first: dict[str, Vector] = {"other": (1.0, 2.0, 3.0)}
    writer.write(first)
    before = os.pread(writer.fd, 1 << 10, 0)
    writer.write({"other": (4.0, 5.0, 6.0)})
    after = os.pread(writer.fd, 1 << 10, 0)
    changed = [at for at in range(len(before)) if before[at] != after[at]]
    for end in changed[1:]:  # all bytes that differ except the first may be missing
        os.pwrite(writer.fd, after[:end] + before[end:], 0)
        assert Neighbourhood(writer.fd, len(NAMES)).targets(BODIES) == expected(first)


def test_memory_for_fewer_robots_is_refused(writer: PlacesWriter) -> None:
    with pytest.raises(ValueError, match="greater than file size"):
        Neighbourhood(writer.fd, 200)


def test_the_range_to_a_robot_is_its_distance_less_its_radius(writer: PlacesWriter) -> None:
    neighbourhood = Neighbourhood(writer.fd, len(NAMES))
    bodies = [neighbour(1, load_profile("turtlebot3_burger"))]
    scanner = Sensor("/scan", LASER_SCAN, 5.0, "base_scan", 360)
    source = Source(scanner, (), lambda: neighbourhood.targets(bodies))
    own = OwnMotion(place_m=(10.0, 20.0, 5.0 + ANTENNA_M), heading_rad=math.pi / 2)

    def scan(**places_m: Vector) -> np.ndarray:
        writer.write(places_m)
        data = source.message(0, 0, own)
        message: Any = shipped().ros1.deserialize_ros1(data, "sensor_msgs/msg/LaserScan")
        return np.asarray(message.ranges)

    for distance_m in (2.0, 3.0, 1.0):
        ranges = scan(own=own.place_m, other=(10.0, 20.0 + distance_m, 5.0 + ANTENNA_M))
        assert ranges[0] == pytest.approx(distance_m - BURGER_RADIUS_M, abs=6 * LASER_NOISE_M)
        half = math.floor(math.degrees(math.asin(BURGER_RADIUS_M / distance_m)))
        assert np.isfinite(ranges).nonzero()[0].tolist() == [*range(half + 1), *range(360 - half, 360)]
    to_the_right = scan(other=(12.0, 20.0, 5.0 + ANTENNA_M))
    assert to_the_right[270] == pytest.approx(2.0 - BURGER_RADIUS_M, abs=6 * LASER_NOISE_M)
    assert to_the_right[0] == math.inf
    assert np.isinf(scan(other=(10.0, 22.0, 6.0 + ANTENNA_M))).all(), "it flies above the beams"
    assert np.isinf(scan(other=(10.0, 24.0, 5.0 + ANTENNA_M))).all(), "it is beyond 3.5 m"
    assert np.isinf(scan()).all(), "it is not in the world"


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
