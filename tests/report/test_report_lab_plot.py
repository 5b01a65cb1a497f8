"""The overview of a lab: names are inside the drawn world for all positions of robots."""

import itertools

import pytest
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from fieldkit.lab.protocol import LabLink, Overview
from fieldkit.report import figures


@pytest.mark.parametrize("area_m", [(400.0, 20.0), (46.0, 24.0)])
def test_names_of_robots_at_the_edges_are_inside_the_world(
    area_m: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    east_m, north_m = area_m
    corners = ((0.0, 0.0), (east_m, 0.0), (0.0, north_m), area_m)
    robots = {f"{letter}-{'long' * 7}": place_m for letter, place_m in zip("abcd", corners, strict=True)}
    links = [LabLink(ends, 30.0, True, ("concrete", "foliage")) for ends in itertools.combinations(robots, 2)]
    overview_figures: list[Figure] = []

    def keep_figure(figure: Figure, form: str, *, transparent: bool) -> bytes:
        figure.draw_without_rendering()
        overview_figures.append(figure)
        return b""

    monkeypatch.setattr(figures, "_to_bytes", keep_figure)
    figures.overview(Overview("a world with a long name " * 4, area_m, [], robots, links), "png")
    axes = overview_figures[0].axes[0]
    world = axes.get_window_extent()
    names = [text for text in axes.texts if isinstance(text, Annotation)]
    assert {text.get_text() for text in names} >= robots.keys()
    for text in names:
        extent = text.get_window_extent()
        assert world.x0 - 1 <= extent.x0 <= extent.x1 <= world.x1 + 1, text
    assert axes.title.get_window_extent().x1 <= overview_figures[0].bbox.x1
