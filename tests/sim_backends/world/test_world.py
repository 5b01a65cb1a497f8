"""Worlds: obstacles and losses of paths, compared with closed forms and with sampling along the path."""

import cmath
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config.schema import parse, validate
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Scenario, Vector
from sim_backends.world.materials import MATERIALS, Foliage, Solid
from sim_backends.world.penetration import Obstacles, Solids
from sim_backends.world.shapes import Box, Cylinder, Floats, Shape
from sim_backends.world.world import World, load_world

WIFI_HZ = 2.437e9
ANTENNA_M = 0.2

WORLD = """\
name: yard
summary: one wall
area_m: [20, 10]
obstacles:
  - {name: wall, kind: wall, from_m: [X, 2], to_m: [X, 8], height: 2.4m, thickness: 0.2m, material: concrete}
  - {name: hill, kind: raised, centre_m: [15, 5], size_m: [4, 4, 1], yaw_deg: 45}
"""


def world(x: float = 5, text: str = WORLD) -> World:
    return validate(parse(text.replace("X", str(x)), source="yard.yaml"), World)


def loss_db(yard: World, start: Vector, end: Vector) -> float:
    return float(Obstacles(yard).penetration_loss_db(np.array([start]), np.array([end]), WIFI_HZ)[0])


def crossed_parts(yard: World, start: Vector, end: Vector) -> list[tuple[str, float]]:
    """Return the material and the rounded length in metres of each part that a path crosses."""
    (crossings,) = Obstacles(yard).crossings(np.array([start]), np.array([end]))
    return [(crossing.material, round(crossing.length_m, 9)) for crossing in crossings]


def test_the_loss_of_a_concrete_wall_follows_itu() -> None:
    """1636 sigma/sqrt(eps) = 47 dB/m and 0.7 dB a face (ITU-R P.2040-1, eq. 26 for small losses)."""
    sigma = 0.0326 * 2.437**0.8095
    expected = 0.2 * 1636 * sigma / math.sqrt(5.31) + 2 * 0.74
    assert loss_db(world(), (0, 5, 0.2), (10, 5, 0.2)) == pytest.approx(expected, abs=0.05)
    assert crossed_parts(world(), (0, 5, 0.2), (10, 5, 0.2)) == [("concrete", 0.2)]


@pytest.mark.parametrize(("name", "thickness_m"), [("concrete", 0.2), ("brick", 0.2), ("wood", 0.1), ("ground", 1.0)])
@pytest.mark.parametrize("frequency_hz", [2.437e9, 5.2e9])
def test_the_loss_of_a_thick_wall_is_near_that_of_an_itu_slab(
    name: str, thickness_m: float, frequency_hz: float
) -> None:
    """ITU-R P.2040-1, 2.2.2: one slab at normal incidence, with inner reflections, which the model omits."""
    solid = MATERIALS[name]
    assert isinstance(solid, Solid)
    root = cmath.sqrt(solid.permittivity(frequency_hz))
    face = (1 - root) / (1 + root)
    first = cmath.exp(-2j * math.pi * thickness_m * frequency_hz / 299_792_458 * root)
    slab_db = -20 * math.log10(abs((1 - face**2) * first / (1 - face**2 * first**2)))
    loss = thickness_m * solid.loss_db_per_m(frequency_hz) + 2 * solid.face_loss_db(frequency_hz)
    assert loss == pytest.approx(slab_db, abs=0.5)


def test_the_loss_depends_on_the_position_of_a_wall() -> None:
    start, end = (0.0, 5.0, 0.2), (10.0, 5.0, 0.2)
    assert loss_db(world(5), start, end) > 10
    assert loss_db(world(12), start, end) == 0
    slanting_loss_db = loss_db(world(5), (0, 2, 0.2), (10, 8, 0.2))
    assert slanting_loss_db > loss_db(world(5), start, end), "a slanting path is longer inside"


def test_a_path_above_or_beside_a_wall_has_no_crossings() -> None:
    starts = np.array([[0, 5, 0.2], [0, 5, 3.0], [0, 1, 0.2], [0, 8.5, 0.2]])
    ends = np.array([[10, 5, 0.2], [10, 5, 3.0], [10, 1, 0.2], [10, 8.5, 0.2]])
    assert [not parts for parts in Obstacles(world()).crossings(starts, ends)] == [False, True, True, True]


def test_crossings_are_computed_separately_for_each_path() -> None:
    starts = np.array([[0, 5, 0.2], [0, 5, 3.0], [0, 5, 0.2]])
    ends = np.array([[10, 5, 0.2], [10, 5, 3.0], [20, 5, 0.2]])
    first, second, third = Obstacles(world()).crossings(starts, ends)
    assert [(crossing.obstacle, crossing.material, round(crossing.length_m, 9)) for crossing in first] == [
        ("wall", "concrete", 0.2)
    ]
    assert second == ()
    assert [crossing.obstacle for crossing in third] == ["wall", "hill"]
    losses_db = Obstacles(world()).penetration_loss_db(starts, ends, WIFI_HZ)
    assert [not path_db for path_db in losses_db] == [not crossings for crossings in (first, second, third)]


def test_raised_ground_has_a_height_and_blocks_paths_through_it() -> None:
    yard = world()
    assert [yard.ground_m(place) for place in ((15, 5), (15, 7.7), (15, 8), (17, 7))] == [1.0, 1.0, 0.0, 0.0]
    assert loss_db(yard, (10, 5, 0.2), (20, 5, 0.2)) > 100
    assert loss_db(yard, (10, 5, 1.2), (20, 5, 1.2)) == 0


def test_the_loss_of_foliage_depends_on_its_total_depth() -> None:
    foliage = MATERIALS["foliage"]
    assert isinstance(foliage, Foliage)
    assert foliage.loss_db(10, 1e9) == pytest.approx(4.5)
    assert foliage.loss_db(100, 1e9) == pytest.approx(1.33 * 100**0.588)
    trees = "".join(
        f"  - {{name: t{n}, kind: tree, at_m: [{10 * n}, 0], height: 8m, crown_base: 2m, crown_radius: 4m,"
        " trunk_radius: 0.2m}\n"
        for n in (1, 2, 3)
    )
    yard = world(text=WORLD[: WORLD.index("  - ")] + trees)
    assert loss_db(yard, (0, 0, 5), (40, 0, 5)) == pytest.approx(foliage.loss_db(24, WIFI_HZ))
    assert {material for material, _ in crossed_parts(yard, (0, 0, 1), (40, 0, 1))} == {"wood"}


def test_a_building_is_empty_inside() -> None:
    house = (
        "  - {name: house, kind: building, centre_m: [10, 5], size_m: [6, 4, 3], thickness: 0.2m, material: brick}\n"
    )
    yard = world(text=WORLD[: WORLD.index("  - ")] + house)
    assert crossed_parts(yard, (0, 5, 1), (20, 5, 1)) == [("brick", 0.2)] * 2
    assert crossed_parts(yard, (9, 5, 1), (11, 5, 1)) == []
    assert crossed_parts(yard, (10, 5, 1), (10, 5, 5)) == [("brick", 0.2)]


@pytest.mark.parametrize("name", ["lawn", "baylands"])
@pytest.mark.parametrize("scenario", list(Scenario))
def test_lines_of_shipped_worlds_have_the_stated_line_of_sight(name: str, scenario: Scenario) -> None:
    yard = load_world(name)
    line = yard.lines[scenario]
    places = [line.at(distance) for distance in (0.0, 18.3)]
    start, end = (np.array([[*place, yard.ground_m(place) + ANTENNA_M]]) for place in places)
    assert Obstacles(yard).crossings(start, end).count(()) == (scenario is Scenario.LOS)


COORDINATE = st.floats(-10, 10).map(lambda value: round(value, 3))
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)
LENGTH = st.floats(0.5, 8)
SHAPE = st.one_of(
    st.builds(Box, POINT, st.tuples(LENGTH, LENGTH, LENGTH), st.floats(-4, 4)),
    st.builds(Cylinder, POINT, LENGTH, LENGTH),
)


def is_inside(shape: Shape, points: Floats) -> Any:  # noqa: ANN401 (a mask)
    x, y, z = (points - shape.centre_m).T
    if isinstance(shape, Cylinder):
        return (np.hypot(x, y) < shape.radius_m) & (abs(z) < shape.height_m / 2)
    along_m = x * math.cos(shape.yaw_rad) + y * math.sin(shape.yaw_rad)
    across_m = y * math.cos(shape.yaw_rad) - x * math.sin(shape.yaw_rad)
    return (
        (abs(along_m) < shape.size_m[0] / 2) & (abs(across_m) < shape.size_m[1] / 2) & (abs(z) < shape.size_m[2] / 2)
    )


@given(st.lists(SHAPE, min_size=1, max_size=3), POINT, POINT)
def test_depths_equal_a_sampling_along_the_path(shapes: list[Shape], start: Vector, end: Vector) -> None:
    steps = 4000
    points = np.linspace(start, end, steps)
    length_m = math.dist(start, end)
    depths = Solids(shapes).depths_m(np.array([start]), np.array([end]))[0]
    sampled_depths_m = [is_inside(shape, points).mean() * length_m for shape in shapes]
    assert depths == pytest.approx(sampled_depths_m, abs=3 * length_m / steps + 1e-9)


@given(st.lists(SHAPE, max_size=3), POINT, POINT)
def test_a_path_is_the_same_in_both_directions(shapes: list[Shape], start: Vector, end: Vector) -> None:
    forward, reverse = (
        Solids(shapes).depths_m(np.array([first]), np.array([second]))
        for first, second in ((start, end), (end, start))
    )
    np.testing.assert_allclose(forward, reverse, atol=1e-9)


def test_solids_absorb_more_at_a_higher_frequency() -> None:
    for name, material in MATERIALS.items():
        if isinstance(material, Solid):
            assert material.loss_db_per_m(5.2e9) >= material.loss_db_per_m(2.4e9) > 0, name
            assert material.face_loss_db(2.4e9) > 0


@pytest.mark.parametrize(
    ("valid_text", "message"),
    [
        ("material: concrete", "there is no material 'concrte'; did you mean 'concrete'"),
        ("kind: wall", "kind"),
        ("height: 2.4m", "height"),
    ],
)
def test_an_invalid_world_is_reported_with_its_line(valid_text: str, message: str) -> None:
    invalid_texts = {
        "material: concrete": "material: concrte",
        "kind: wall": "kind: fence",
        "height: 2.4m": "height: 2.4",
    }
    with pytest.raises(ConfigurationError, match=message) as error_info:
        world(text=WORLD.replace(valid_text, invalid_texts[valid_text]))
    assert error_info.value.where.startswith("yard.yaml:")


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (
            "kind: tree, at_m: [5, 5], height: 2m, crown_base: 2m, crown_radius: 1m, trunk_radius: 0.1m",
            "the lower end of the crown must be below its top",
        ),
        (
            "kind: building, centre_m: [5, 5], size_m: [6, 4, 3], thickness: 2m, material: brick",
            "the walls or the roof fill the whole building",
        ),
    ],
)
def test_sizes_that_contradict_each_other_are_an_error(obstacle: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        world(text=f"{WORLD}  - {{name: extra, {obstacle}}}\n")


def test_an_unknown_world_is_an_error_with_a_suggestion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match="no world 'lwn'") as error_info:
        load_world("lwn")
    assert error_info.value.remedy == "did you mean 'lawn'?"
    (tmp_path / "worlds").mkdir()
    (tmp_path / "worlds" / "yard.yaml").write_text(WORLD.replace("X", "5"), encoding="utf-8")
    assert load_world("yard").name == "yard"


def test_a_ramp_rises_evenly_and_blocks_radio_paths_in_steps() -> None:
    text = WORLD + "  - {name: ramp, kind: ramp, centre_m: [10, 1], size_m: [4, 2, 1], yaw_deg: 90}\n"
    heights_m = [world(text=text).ground_m((10.5, north_m)) for north_m in (-1.1, -1.0, 0.0, 1.0, 3.0)]
    assert heights_m == pytest.approx([0.0, 0.0, 0.25, 0.5, 1.0], abs=1e-12)
    # Half of its length is higher than half of its height.
    assert crossed_parts(world(text=text), (10, -5, 0.5001), (10, 2.9, 0.5001)) == [("ground", 0.5)] * 3 + [
        ("ground", 0.4)
    ]
