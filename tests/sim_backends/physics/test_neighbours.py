"""A neighbour list of many bodies equals the lists of all pairs; a grid search returns all bodies nearby."""

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

from sim_backends.physics.body import Body
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.ground import Ground
from sim_backends.physics.neighbours import CellGrid, Neighbours
from sim_backends.physics.quadrotor import Quadrotor
from sim_backends.physics.robot_limits import HUSKY_A200, IRIS
from tests.helpers.nightly import examples
from tests.helpers.worlds import world

COORDINATE = st.floats(-30, 30)
PLACES = st.tuples(COORDINATE, COORDINATE, st.floats(0, 10))
HORIZON_S = 0.2
YARD = world({"name": "oak", "kind": "tree", "at_m": (0, 3), "trunk_radius": "0.3m"})


@given(st.lists(PLACES, max_size=40), PLACES, st.floats(0, 20))
@example([(1.0, 1.0, 0.0)], (1.0, 1.0, 0.0), 5e-324)
def test_a_grid_search_returns_the_indices_of_all_bodies_nearby(
    places_m: list[tuple[float, float, float]], place_m: tuple[float, float, float], within_m: float
) -> None:
    grid = CellGrid(within_m)
    for index, other_m in enumerate(places_m):
        grid.add(index, other_m)
    indices = grid.nearby_indices(place_m)
    assert indices == sorted(set(indices))
    expected = {index for index, other_m in enumerate(places_m) if math.dist(other_m[:2], place_m[:2]) <= within_m}
    assert expected <= set(indices)


def test_a_grid_search_omits_distant_bodies() -> None:
    grid = CellGrid(1.0)
    grid.add(0, (100.0, 0.0, 0.0))
    assert grid.nearby_indices((0.0, 0.0, 0.0)) == []


def neighbour_list(bodies: Mapping[str, Body[Any]]) -> Neighbours:
    grounds = {name: Ground(YARD, None if body.flies else body.max_grade) for name, body in bodies.items()}
    return Neighbours(bodies, {name: body.initial_pose() for name, body in bodies.items()}, grounds, HORIZON_S)


def body(flies: bool, place_m: tuple[float, float, float]) -> Body[Any]:
    return Quadrotor(IRIS, place_m) if flies else DifferentialDrive(HUSKY_A200, place_m[:2])


BODIES = st.lists(
    st.builds(body, st.booleans(), st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(1, 4))),
    min_size=2,
    max_size=12,
).map(lambda bodies: {f"r{number:02}": body for number, body in enumerate(bodies)})


@settings(max_examples=examples(60))
@given(BODIES)
def test_a_list_of_many_bodies_equals_the_lists_of_all_pairs(bodies: dict[str, Body[Any]]) -> None:
    neighbours_of_all = neighbour_list(bodies)
    pairs = {pair: neighbour_list({name: bodies[name] for name in pair}) for pair in combinations(bodies, 2)}
    for name in bodies:
        pairs_of_body = [pair for pair in pairs if name in pair]
        expected = [
            next(other for other in pair if other != name)
            for pair in pairs_of_body
            if name in pairs[pair].candidates and pairs[pair].candidates[name].bodies
        ]
        assert (neighbours_of_all.candidates[name].bodies if name in neighbours_of_all.candidates else []) == expected
        assert neighbours_of_all.min_time_to_contact_s(name) == min(
            pairs[pair].min_time_to_contact_s(name) for pair in pairs_of_body
        )
