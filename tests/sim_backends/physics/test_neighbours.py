"""Who may meet whom, of many, is what lists of any two alone say; and a grid leaves out nobody who is near."""

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

from sim_backends.physics.body import Body
from sim_backends.physics.differential_drive import HUSKY_A200, DifferentialDrive
from sim_backends.physics.grid import CellGrid
from sim_backends.physics.ground import Ground
from sim_backends.physics.neighbours import Neighbours
from sim_backends.physics.quadrotor import IRIS, Quadrotor
from tests.helpers.worlds import world

COORDINATE = st.floats(-30, 30)
PLACES = st.tuples(COORDINATE, COORDINATE, st.floats(0, 10))
HORIZON_S = 0.2
YARD = world({"name": "oak", "kind": "tree", "at_m": (0, 3), "trunk_radius": "0.3m"})


@given(st.lists(PLACES, max_size=40), PLACES, st.floats(0, 20))
@example([(1.0, 1.0, 0.0)], (1.0, 1.0, 0.0), 5e-324)
def test_a_grid_leaves_out_nobody_who_is_near(
    places_m: list[tuple[float, float, float]], place_m: tuple[float, float, float], within_m: float
) -> None:
    grid = CellGrid(within_m)
    for number, one_m in enumerate(places_m):
        grid.add(number, one_m)
    found = grid.near(place_m)
    assert found == sorted(set(found))
    near = {number for number, one_m in enumerate(places_m) if math.dist(one_m[:2], place_m[:2]) <= within_m}
    assert near <= set(found)


def test_a_grid_leaves_out_who_is_far() -> None:
    grid = CellGrid(1.0)
    grid.add(0, (100.0, 0.0, 0.0))
    assert grid.near((0.0, 0.0, 0.0)) == []


def listed(bodies: Mapping[str, Body[Any]]) -> Neighbours:
    grounds = {name: Ground(YARD, None if body.flies else body.steepest) for name, body in bodies.items()}
    return Neighbours(bodies, {name: body.begin() for name, body in bodies.items()}, grounds, HORIZON_S)


def body(flies: bool, place_m: tuple[float, float, float]) -> Body[Any]:
    return Quadrotor(IRIS, place_m) if flies else DifferentialDrive(HUSKY_A200, place_m[:2])


BODIES = st.lists(
    st.builds(body, st.booleans(), st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(1, 4))),
    min_size=2,
    max_size=12,
).map(lambda some: {f"r{number:02}": one for number, one in enumerate(some)})


@settings(max_examples=60)
@given(BODIES)
def test_a_list_of_many_says_of_any_two_what_a_list_of_these_alone_says(bodies: dict[str, Body[Any]]) -> None:
    many = listed(bodies)
    pairs = {pair: listed({name: bodies[name] for name in pair}) for pair in combinations(bodies, 2)}
    for name in bodies:
        of_it = [pair for pair in pairs if name in pair]
        near = [
            next(one for one in pair if one != name)
            for pair in of_it
            if name in pairs[pair].near and pairs[pair].near[name].bodies
        ]
        assert (many.near[name].bodies if name in many.near else []) == near
        assert many.free_s(name) == min(pairs[pair].free_s(name) for pair in of_it)
