"""Figures of co-simulations: everything has a label, zeros are separate, and equal figures are equal files."""

import math
import re

import pytest

from fieldkit.report.theme import FORMATS, Format
from sim_backends.cosim.plot_layout import Curve, FlowTrace, LogPanel, ObstacleOutline, direction_arrow, outlines
from sim_backends.cosim.plots import log_figure, run_figure
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
        Curve("another", [5.0], [0.3], "another\norder 2"),
    ],
)
FLOWS = [
    FlowTrace("pose/ann", [0.0, 1.0, 2.0], [0.001, math.nan, 0.003], [5.0, 6.0, 7.0]),
    FlowTrace("map/bob", [0.5, 1.5], [0.01, 0.1], [5.0, 5.0]),
]
PATHS_M = {"ann": [(0.0, 0.0)], "bob": [(0.0, 5.0), (5.0, 5.0)]}


def texts(svg: bytes) -> list[str]:
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg.decode()) + re.findall(
        r"<tspan[^>]*>([^<]*)</tspan>", svg.decode()
    )


def draw_all(file_format: Format) -> list[bytes]:
    return [log_figure([PANEL], file_format), run_figure("a run", PATHS_M, FLOWS, file_format)]


@pytest.mark.parametrize("file_format", FORMATS)
def test_equal_figures_are_equal_files_in_every_format(file_format: Format) -> None:
    figures = draw_all(file_format)
    assert all(figure.startswith(MAGIC[file_format]) for figure in figures)
    assert figures == draw_all(file_format)


def test_each_curve_has_one_label_and_zeros_have_a_separate_line() -> None:
    labels = texts(log_figure([PANEL, PANEL], "svg"))
    for name in ("scheduled", "time_stepped", "event_driven", "another"):
        assert labels.count(name) == 2, "once in each panel"
    assert labels.count("0") == 2
    without_zeros = LogPanel("x", "x", "y", PANEL.curves[:2])
    assert "0" not in texts(log_figure([without_zeros], "svg"))


def test_obstacles_are_drawn_and_paths_have_an_arrow() -> None:
    without_wall = run_figure("a run", PATHS_M, FLOWS, "svg").decode()
    wall = ObstacleOutline([(0.0, 1.0), (2.0, 1.0), (2.0, 1.2), (0.0, 1.2)], is_passable=False)
    with_wall = run_figure("a run", PATHS_M, FLOWS, "svg", [wall]).decode()
    assert with_wall.count("<path") == without_wall.count("<path") + 1
    assert texts(with_wall.encode()) == texts(without_wall.encode()), "the axes are unchanged"
    stationary_figure = run_figure("a run", {name: path[:1] for name, path in PATHS_M.items()}, FLOWS, "svg").decode()
    assert without_wall.count("<path") > stationary_figure.count("<path"), "an agent that does not move has no arrow"


def test_arrows_have_the_last_direction_of_travel() -> None:
    there_and_back = [(0.0, 0.0), (0.0, 5.0), (0.0, 10.0), (0.0, 9.0), (0.0, 6.0)]
    assert direction_arrow(there_and_back) == ((0.0, 9.0), (0.0, 6.0))
    assert direction_arrow([*there_and_back, (0.0, 6.0)]) == ((0.0, 9.0), (0.0, 6.0)), "it does not move at the end"
    assert direction_arrow([(1.0, 1.0)]) is direction_arrow([(1.0, 1.0)] * 3) is None


def test_the_outlines_of_the_park_are_passable_below_roofs_and_impassable_at_boxes() -> None:
    park = load_world("baylands")
    park_outlines = list(outlines(park))
    assert any(outline.is_passable for outline in park_outlines)
    assert any(not outline.is_passable for outline in park_outlines)
    assert len(park_outlines) == sum(1 for obstacle in park.obstacles for _ in obstacle.parts())


def test_labels_at_the_right_do_not_remove_numbers_of_the_axis() -> None:
    panel = LogPanel(
        "x",
        "window (ms)",
        "y",
        [Curve("scheduled", [1.0, 10.0], [1.0, 5.0], "scheduled\norder 1")],
        labels_at_right=True,
    )
    labels = texts(log_figure([panel], "svg"))
    assert {"1", "10", "order 1"} <= set(labels)
    assert "100" not in labels, "the part of the axis below the labels has no number"


def test_a_run_has_names_of_agents_and_flows_and_a_legend_of_losses_if_there_are_any() -> None:
    labels = texts(run_figure("a run", PATHS_M, FLOWS, "svg"))
    assert {"ann", "bob", "pose/ann", "map/bob", "a run", "| lost"} <= set(labels)
    assert "| lost" not in texts(run_figure("a run", PATHS_M, FLOWS[1:], "svg"))
    assert texts(run_figure("nothing was sent", {"ann": [(0.0, 0.0)]}, [], "svg"))
