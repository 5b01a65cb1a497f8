"""Ranges of the laser, compared with plane geometry for walls, rooms and trunks, and with the radio's solids."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.provisioning import laser_targets
from sim_backends.emulated.ros.laser import LaserTarget, ranges_m
from sim_backends.world.shapes import Box, Cylinder, Solids
from sim_backends.world.world import World, load_world

BEAMS = 360
REACH_M = 100.0
ROOM = LaserTarget(((0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)), 0.0, 0.0, 2.0)
"""From inside, its edges are the walls of a room."""


def scan(*targets: LaserTarget, east_m: float, north_m: float, heading_rad: float = 0.0) -> list[float]:
    return ranges_m(targets, (east_m, north_m, 0.2), heading_rad, BEAMS, REACH_M)


def test_a_wall_ahead_is_its_distance_by_the_cosine_away() -> None:
    wall = LaserTarget(((5.0, -1.0), (5.2, -1.0), (5.2, 1.0), (5.0, 1.0)), 0.0, 0.0, 2.0)
    ranges = scan(wall, east_m=2.0, north_m=0.0)
    sees = math.degrees(math.atan2(1.0, 3.0))  # 18.4 degrees to either side
    for beam, range_m in enumerate(ranges):
        angle = (beam + 180) % 360 - 180
        expected_m = 3.0 / math.cos(math.radians(angle)) if abs(angle) <= sees else math.inf
        assert range_m == pytest.approx(expected_m), angle


@given(st.floats(0.2, 5.8), st.floats(0.2, 3.8), st.floats(-10, 10))
def test_ranges_in_a_rectangular_room_agree_with_trigonometry(
    east_m: float, north_m: float, heading_rad: float
) -> None:
    angles = heading_rad + np.arange(BEAMS) * math.radians(1)
    with np.errstate(divide="ignore", over="ignore"):
        across = np.where(np.cos(angles) > 0, (6.0 - east_m) / np.cos(angles), -east_m / np.cos(angles))
        along = np.where(np.sin(angles) >= 0, (4.0 - north_m) / np.sin(angles), -north_m / np.sin(angles))
    ranges = scan(ROOM, east_m=east_m, north_m=north_m, heading_rad=heading_rad)
    np.testing.assert_allclose(ranges, np.minimum(across, along), rtol=1e-6)


def test_a_trunk_is_nearest_in_the_middle_and_ends_at_its_tangents() -> None:
    trunk = LaserTarget(((0.0, 3.0),), 0.5, 0.0, 2.0)
    ranges = scan(trunk, east_m=0.0, north_m=0.0)
    assert ranges[90] == pytest.approx(2.5)
    hit = [beam for beam, range_m in enumerate(ranges) if math.isfinite(range_m)]
    half = math.floor(math.degrees(math.asin(0.5 / 3.0)))
    assert hit == list(range(90 - half, 90 + half + 1))


def test_only_solids_at_the_laser_s_height_end_a_beam() -> None:
    crown = LaserTarget(((0.0, 3.0),), 2.0, 1.0, 4.0)
    step = LaserTarget(((1.0, -1.0), (2.0, -1.0), (2.0, 1.0), (1.0, 1.0)), 0.0, 0.0, 0.1)
    assert set(scan(crown, step, east_m=0.0, north_m=0.0)) == {math.inf}


def test_surfaces_out_of_reach_are_infinite_and_the_nearer_one_hides_the_other() -> None:
    near = LaserTarget(((2.0, -9.0), (2.0, 9.0), (2.1, 0.0)), 0.0, 0.0, 2.0)
    far = LaserTarget(((3.0, -9.0), (3.0, 9.0), (3.1, 0.0)), 0.0, 0.0, 2.0)
    assert ranges_m([far, near], (0.0, 0.0, 0.2), 0.0, BEAMS, 3.5)[0] == pytest.approx(2.0)
    assert ranges_m([far], (0.0, 0.0, 0.2), 0.0, BEAMS, 2.5)[0] == math.inf


@pytest.mark.parametrize("name", ["lawn", "baylands"])
def test_beams_end_where_the_radio_s_paths_enter_a_solid(name: str) -> None:
    """An independent calculation: a beam is in no solid before its end, and in one just behind it."""
    world: World = load_world(name)
    solids = Solids([part.shape for part in world.parts])
    targets = laser_targets(world)
    numbers = np.random.default_rng(1)
    hits = missed = 0
    near = [part.shape.centre_m[:2] for part in world.parts for _ in range(max(1, 40 // len(world.parts)))]
    for east_m, north_m in (np.array(near) + numbers.normal(0, 6, (len(near), 2))).tolist():
        start = np.tile((east_m, north_m, 0.2), (BEAMS, 1))
        if solids.depths_m(start[:1], np.add(start[:1], (0, 0, 1e-6))).any():
            continue  # in a solid
        ranges = np.array(ranges_m(targets, (east_m, north_m, 0.2), 0.3, BEAMS, 20.0))
        angles = 0.3 + np.arange(BEAMS) * math.radians(1)
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEAMS)], axis=1)
        before = start + directions * (np.minimum(ranges, 20.0) - 1e-3)[:, None]
        assert solids.depths_m(start, before).max() < 1e-2, "only beams that graze a corner or a trunk"
        hit = np.isfinite(ranges)
        hits += int(hit.sum())
        behind = start + directions * (np.where(hit, ranges, 0.0) + 1e-3)[:, None]
        depths_m = solids.depths_m(start, behind).sum(axis=1)[hit]
        missed += int((depths_m <= 1e-6).sum())
    assert hits > 100
    assert missed < 0.01 * hits, "only beams that touch a corner"


def test_shapes_of_a_world_keep_their_heights() -> None:
    world = load_world("lawn")
    (wall,) = laser_targets(world)
    (part,) = world.parts
    assert isinstance(part.shape, Box)
    assert (wall.base_m, wall.top_m, wall.radius_m) == pytest.approx((0.0, 2.4, 0.0))
    trees = [target for target in laser_targets(load_world("baylands")) if target.radius_m]
    assert len(trees) == sum(isinstance(part.shape, Cylinder) for part in load_world("baylands").parts)
