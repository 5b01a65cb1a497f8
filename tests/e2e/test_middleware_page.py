"""The figures of docs/studies/middleware.md equal its table, with the numbers of samples and the intervals."""

import re

import pytest
import scipy

from benchmarks.studies import middleware, middleware_table
from benchmarks.studies.middleware_cells import MiddlewareFindings
from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "studies" / "middleware.md"
TABLE = PAGE.with_suffix(".csv")


def test_every_point_of_the_loss_figure_has_its_interval_and_its_number_of_samples() -> None:
    cells = middleware_table.cells(TABLE)
    chart = middleware.by_distance(MiddlewareFindings(cells, "", 0.0, 0.0), "middleware-loss", middleware.LOSS)
    points = [
        point
        for panel in chart.panels
        for series in panel.series
        for point in zip(series.y, series.low, series.high, strict=True)
    ]
    assert len(points) == len([cell for cell in cells if cell.robots == 2]) >= 4 * 70
    for value, low, high in points:
        assert low is not None
        assert high is not None
        assert 0 <= low <= value <= high <= 100
    assert {re.sub(r".*, (n = .*)", r"\1", panel.title) for panel in chart.panels} == {
        "n = 80 (2 repeats)",
        "n = 20 (2 repeats)",
    }
    assert {series.join for panel in chart.panels for series in panel.series} == {"none"}


def test_a_bimodal_loss_is_marked_in_the_table() -> None:
    table = TABLE.read_text(encoding="utf-8")
    bimodal_rows = [line.split(",") for line in table.splitlines() if line.endswith(f",{middleware_table.BIMODAL}")]
    assert [row[:5] for row in bimodal_rows] == [
        ["1000000", "reliable", "Zenoh", "2", str(metres)] for metres in (20, 40, 60, 80)
    ]


def test_the_table_can_be_generated_from_its_cells() -> None:
    table_text = middleware_table.text(middleware_table.cells(TABLE), list(middleware.STYLES))
    assert table_text == TABLE.read_text(encoding="utf-8")


@pytest.mark.parametrize(("size_bytes", "samples", "lost"), [(1_000, 80, 0), (1_000, 80, 20), (1_000_000, 20, 15)])
def test_the_interval_counts_samples_within_half_a_second_as_one(size_bytes: int, samples: int, lost: int) -> None:
    trials = samples / (5 if size_bytes < 1_000_000 else 1)
    low, high = middleware_table.interval(lost / samples, size_bytes, samples)
    z = scipy.stats.norm.ppf(0.975)
    p = lost / samples
    centre = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * (p * (1 - p) / trials + z**2 / (4 * trials**2)) ** 0.5
    assert (low, high) == pytest.approx((max(centre - half, 0.0), min(centre + half, 1.0)), abs=1e-9)


def test_the_intervals_quoted_on_the_page_are_those_of_its_table() -> None:
    cells_by_key = {
        (cell.middleware, cell.kind, cell.size_bytes, cell.robots, cell.distance_m): cell
        for cell in middleware_table.cells(TABLE)
    }
    text = PAGE.read_text(encoding="utf-8")
    for key, quoted_text in (
        (("Fast DDS", "reliable", 1_000_000, 2, 20.0), "75 % [53, 89]"),
        (("Fast DDS, tuned", "reliable", 1_000_000, 2, 20.0), "5 % [1, 24]"),
        (("Fast DDS", "reliable", 10_000, 5, 60.0), "30 % [20, 42]"),
    ):
        cell = cells_by_key[key]
        assert cell.loss is not None
        assert cell.loss_low is not None
        assert cell.loss_high is not None
        assert f"{100 * cell.loss:.0f} % [{100 * cell.loss_low:.0f}, {100 * cell.loss_high:.0f}]" == quoted_text
        assert quoted_text in text
    assert "95 % [76, 99]" not in text  # the rate of Zenoh's images cannot be estimated from two repeats
