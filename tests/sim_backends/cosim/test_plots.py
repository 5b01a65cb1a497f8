"""Figures of co-simulations: everything is named, zero is told apart, and equal figures are equal files."""

import math
import re

import pytest

from fieldkit.report.theme import FORMATS, Format
from sim_backends.cosim.from_above import ObstacleOutline, last_heading, outlines
from sim_backends.cosim.plots import Curve, FlowTrace, LogPanel, log_figure, run_figure
from sim_backends.world.world import load_world

MAGIC = {"svg": b"<?xml", "pdf": b"%PDF", "png": b"\x89PNG"}
PANEL = LogPanel(
    "Delivery",
    "exchanges",
    "error (ms)",
    [
        Curve("scheduled", [20.0, 200.0], [50.0, 5.0]),
        Curve("time_stepped", [20.0, 200.0], [50.0, 5.0]),
        Curve("event_driven", [2000.0], [0.0]),
        Curve("a stranger", [5.0], [0.3], "a stranger\norder 2"),
    ],
)
FLOWS = [
    FlowTrace("pose/ann", [0.0, 1.0, 2.0], [0.001, math.nan, 0.003], [5.0, 6.0, 7.0]),
    FlowTrace("map/bob", [0.5, 1.5], [0.01, 0.1], [5.0, 5.0]),
]
WAYS_M = {"ann": [(0.0, 0.0)], "bob": [(0.0, 5.0), (5.0, 5.0)]}


def texts(svg: bytes) -> list[str]:
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg.decode()) + re.findall(
        r"<tspan[^>]*>([^<]*)</tspan>", svg.decode()
    )


def drawn(form: Format) -> list[bytes]:
    return [log_figure([PANEL], form), run_figure("a run", WAYS_M, FLOWS, form)]


@pytest.mark.parametrize("form", FORMATS)
def test_equal_figures_are_equal_files_in_every_format(form: Format) -> None:
    figures = drawn(form)
    assert all(one.startswith(MAGIC[form]) for one in figures)
    assert figures == drawn(form)


def test_each_curve_is_named_once_and_zero_has_a_line_of_its_own() -> None:
    said = texts(log_figure([PANEL, PANEL], "svg"))
    for name in ("scheduled", "time_stepped", "event_driven", "a stranger"):
        assert said.count(name) == 2, "once in each panel"
    assert said.count("0") == 2
    without = LogPanel("x", "x", "y", PANEL.curves[:2])
    assert "0" not in texts(log_figure([without], "svg"))


def test_what_stands_around_is_drawn_and_ways_have_an_arrow() -> None:
    plain = run_figure("a run", WAYS_M, FLOWS, "svg").decode()
    wall = ObstacleOutline([(0.0, 1.0), (2.0, 1.0), (2.0, 1.2), (0.0, 1.2)], is_light=False)
    around = run_figure("a run", WAYS_M, FLOWS, "svg", [wall]).decode()
    assert around.count("<path") == plain.count("<path") + 1
    assert texts(around.encode()) == texts(plain.encode()), "it changes no axis"
    standing = run_figure("a run", {name: way[:1] for name, way in WAYS_M.items()}, FLOWS, "svg").decode()
    assert plain.count("<path") > standing.count("<path"), "who stands heads nowhere"


def test_arrows_point_where_agents_go_at_last() -> None:
    there_and_back = [(0.0, 0.0), (0.0, 5.0), (0.0, 10.0), (0.0, 9.0), (0.0, 6.0)]
    assert last_heading(there_and_back) == ((0.0, 9.0), (0.0, 6.0))
    assert last_heading([*there_and_back, (0.0, 6.0)]) == ((0.0, 9.0), (0.0, 6.0)), "it stands at the end"
    assert last_heading([(1.0, 1.0)]) is last_heading([(1.0, 1.0)] * 3) is None


def test_the_park_has_its_house_light_below_the_roof_and_its_boxes_dark() -> None:
    found = list(outlines(load_world("baylands")))
    assert any(one.is_light for one in found)
    assert any(not one.is_light for one in found)
    park = load_world("baylands")
    assert len(found) == sum(1 for obstacle in park.obstacles for _ in obstacle.parts())


def test_labels_at_the_right_leave_the_axis_its_numbers() -> None:
    aside = LogPanel(
        "x", "window (ms)", "y", [Curve("scheduled", [1.0, 10.0], [1.0, 5.0], "scheduled\norder 1")], aside=True
    )
    said = texts(log_figure([aside], "svg"))
    assert {"1", "10", "order 1"} <= set(said)
    assert "100" not in said, "no number where only labels are"


def test_a_run_names_its_agents_and_flows_and_tells_losses_only_where_there_are_some() -> None:
    said = texts(run_figure("a run", WAYS_M, FLOWS, "svg"))
    assert {"ann", "bob", "pose/ann", "map/bob", "a run", "| lost"} <= set(said)
    assert "| lost" not in texts(run_figure("a run", WAYS_M, FLOWS[1:], "svg"))
    assert texts(run_figure("nothing was sent", {"ann": [(0.0, 0.0)]}, [], "svg"))
