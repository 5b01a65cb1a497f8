"""Positions of the robots of a lab, its map, and the outlines of shapes."""

import math
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.cli import main
from fieldkit.config.schema import Document, parse, validate
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Scenario, Vector
from fieldkit.lab import requests
from fieldkit.lab.robots import Destination
from fieldkit.report import figures
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions
from sim_backends.emulated.interactive_lab import members_of, overview
from sim_backends.emulated.interactive_placement import destination_m, square_m
from sim_backends.world.penetration import Solids
from sim_backends.world.shapes import Box, Cylinder
from sim_backends.world.world import World, load_world

SITE = """\
backend: field
robots:
  a: {profile: turtlebot3_burger}
  b: {profile: turtlebot3_burger}
roles: {}
"""


def backend(emulated: str = "") -> EmulatedBackend:
    document: Document = parse(SITE + emulated, source="fieldkit.yaml")
    return EmulatedBackend(validate(document, Site), document)


@given(st.integers(1, 253), st.sampled_from(("lawn", "baylands", "open")))
def test_robots_are_placed_apart_inside_the_world(count: int, name: str) -> None:
    world = load_world(name)
    places = square_m([str(number) for number in range(count)], world)
    assert len(set(places.values())) == count
    for east_m, north_m, _ in places.values():
        assert 0 < east_m < world.area_m[0]
        assert 0 < north_m < world.area_m[1]
    least_distance_m = min(
        (math.dist(first, second) for first, second in combinations(places.values(), 2)), default=5.0
    )
    assert 1 < least_distance_m <= 5 + 1e-9


HILL = """\
name: hill
summary: raised ground
area_m: [20, 10]
obstacles:
  - {name: hill, kind: raised, centre_m: [15, 5], size_m: [4, 4, 1]}
"""


@pytest.mark.parametrize(
    ("destination", "expected_m"),
    [
        (Destination(3, 4, None, relative=False), (3, 4, 0.2)),
        (Destination(15, 5, None, relative=False), (15, 5, 1.2)),
        (Destination(15, 5, 7, relative=False), (15, 5, 7)),
        (Destination(0, 10, 0, relative=False), (0, 10, 0)),
        (Destination(10, 0, None, relative=True), (15, 5, 1.5)),
        (Destination(10, 0, 2, relative=True), (15, 5, 3.5)),
        (Destination(-5, 5, -0.5, relative=True), (0, 10, 0)),
    ],
)
def test_a_robot_moves_over_the_ground(destination: Destination, expected_m: Vector) -> None:
    hill = validate(parse(HILL, source="hill.yaml"), World)
    assert destination_m((5, 5, 0.5), destination, hill) == pytest.approx(expected_m)


@pytest.mark.parametrize(
    ("destination", "message"),
    [
        (Destination(20.1, 5, None, relative=False), "20.1 m east, 5 m north is outside of the world hill"),
        (Destination(0, 5.1, None, relative=True), "5 m east, 10.1 m north is outside"),
        (Destination(math.inf, 0, None, relative=False), "inf m east"),
        (Destination(15, 5, 0.9, relative=False), "0.9 m up is not a valid height: the ground is at 1 m"),
        (Destination(0, 0, -0.6, relative=True), "-0.1 m up is not a valid height"),
        (Destination(5, 5, math.inf, relative=False), "inf m up is not a valid height"),
    ],
)
def test_a_robot_stays_in_the_world_and_above_its_ground(destination: Destination, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        destination_m((5, 5, 0.5), destination, validate(parse(HILL, source="hill.yaml"), World))


def test_an_overview_is_unchanged_by_packing_and_unpacking() -> None:
    lab_overview = backend("emulated: {world: baylands}\n").overview()
    assert lab_overview.outlines
    assert requests.unpack_overview(requests.pack_overview(lab_overview)) == lab_overview


def test_a_link_has_the_snr_of_its_closed_form() -> None:
    """5 m, exponent 3, 17 dBm: the loss at 1 m is 20 log10(4 pi f / c), and the noise -95 dBm."""
    (link,) = backend().overview().links
    loss_db = 20 * math.log10(4 * math.pi * 2.437e9 / 299_792_458) + 30 * math.log10(5)
    assert link.ends == ("a", "b")
    assert link.snr_db == pytest.approx(17 - loss_db + 95)
    assert link.linked


def test_a_link_names_the_obstacles_that_it_crosses() -> None:
    lawn, site = load_world("lawn"), validate(parse(SITE, source="fieldkit.yaml"), Site)
    members = members_of(site, None, {"a": "10.42.0.1", "b": "10.42.0.2"})
    lab_overview = {
        scenario: overview(
            members,
            {name: (*line.at(metres), 0.2) for name, metres in (("a", 0.0), ("b", 9.0))},
            EmulatedOptions(),
            lawn,
        )
        for scenario, line in lawn.lines.items()
    }
    assert [link.through for link in lab_overview[Scenario.LOS].links] == [()]
    assert [link.through for link in lab_overview[Scenario.NLOS].links] == [("wall",)]
    assert b"dB, wall" in figures.overview(lab_overview[Scenario.NLOS], "svg")


def test_links_that_places_do_not_change_have_no_snr() -> None:
    assert backend("emulated: {radio: {loss: 10%}}\n").overview().links == []


def test_an_overview_excludes_shadowing() -> None:
    without_shadowing, with_shadowing = backend(), backend("emulated: {radio: {shadowing_db: 8.0}}\n")
    assert without_shadowing.overview() == with_shadowing.overview()


@pytest.mark.parametrize("shape", [Box((3, 4, 1), (2, 6, 2), 0.7), Cylinder((-2, 5, 3), 1.5, 4)])
def test_an_outline_is_the_edge_of_the_shape(shape: Box | Cylinder) -> None:
    """A vertical path just inside a corner crosses the shape, and one just outside does not."""
    centre = np.array(shape.centre_m[:2])
    for corner in shape.corners_m():
        for share, inside in ((0.999, True), (1.001, False)):
            east_m, north_m = centre + share * (np.array(corner) - centre)
            start, end = np.array([[east_m, north_m, -100]]), np.array([[east_m, north_m, shape.top_m]])
            assert (Solids([shape]).depths_m(start, end)[0, 0] > 0) == inside
            path_above = np.array([[*centre, shape.top_m]]), np.array([[*centre, 100.0]])
            assert Solids([shape]).depths_m(*path_above)[0, 0] == pytest.approx(0, abs=1e-9)


def test_the_figure_names_every_robot_and_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["lab", "plot", "--robots", "3"]) == 0
    svg = (tmp_path / "lab.svg").read_text(encoding="utf-8")
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
    assert {"robot-1", "robot-2", "robot-3", "lawn, 3 robots", "SNR (dB)"} <= set(texts)
    assert sorted(text for text in texts if re.fullmatch(r"\d+ dB", text)) == ["46 dB", "51 dB", "51 dB"]
    assert main(["lab", "plot", "--robots", "50", "-o", "many.png"]) == 0
    assert (tmp_path / "many.png").read_bytes().startswith(b"\x89PNG")
