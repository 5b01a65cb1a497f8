"""Content of figures: crosses for missing values, dots for one distance, logarithmic axes, and captions."""

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.table_files import read
from fieldkit.core.columns import fault_column_name
from fieldkit.core.model import FaultKind
from fieldkit.measure.evidence import outage_columns, ping_gaps
from fieldkit.report import distance, distribution, dots, figures
from fieldkit.report.charts import Chart, EdgeMark, Panel, Series
from fieldkit.report.contents import build_contents
from fieldkit.report.series import Identities, needs_log
from fieldkit.report.theme import Format, Style
from fieldkit.report.trial_folders import load_evidence
from fieldkit.trial.columns import trial_columns
from fieldkit.trial.rows import to_csv
from tests.helpers import lawns
from tests.helpers.tables import RepeatRow, parsed, replace

LOST = {"datagrams_received": 0, "datagram_loss": 1.0, "rtt_loss": 1.0, "rtt_median_s": None, "transfer_s": None}


def rows_at(metres: float, repeats: int = 8, **changes: object) -> list[RepeatRow]:
    """Return repeats at one distance whose round-trip times differ by 1 %."""
    rows = [lawns.row(n, distance=f"{metres:g}m", distance_m=metres) for n in range(1, repeats + 1)]
    return [replace(row, **({"rtt_median_s": 0.010 + 1e-4 * n} | changes)) for n, row in enumerate(rows)]


def curves(repeats: Repeats, *names: str) -> list[Chart]:
    evidence = load_evidence(repeats)
    cells = aggregate(repeats)
    return list(distance.charts(cells, Identities(cells), evidence, names))


def dot_charts(repeats: Repeats) -> list[Chart]:
    evidence = load_evidence(repeats)
    cells = aggregate(repeats)
    return list(dots.charts(cells, Identities(cells), evidence))


def panel_of(charts: Sequence[Chart]) -> Panel:
    ((panel,),) = (chart.panels for chart in charts)
    return panel


def test_curve_has_a_cross_at_a_distance_without_arrivals() -> None:
    (chart,) = curves(parsed([*rows_at(10), *rows_at(20), *rows_at(60, 3, **LOST)]), "rtt_median_s")
    (panel,) = chart.panels
    (cross,) = panel.edges
    assert (cross.at, cross.text, cross.is_high) == (60.0, "nothing arrived: 3 of 3", True)
    assert [label for _, label in panel.x_ticks] == ["10m", "20m", "60m"]
    assert panel.right is not None
    assert panel.right > 60
    assert "nothing arrived: 3 of 3 at 60m" in panel.description
    assert "a cross at the edge, with the reason, if a condition has no value" in chart.caption


def test_cross_of_a_missing_rate_is_at_the_bottom() -> None:
    rows = [*rows_at(10, goodput_bit_s=1e6), *rows_at(20, goodput_bit_s=1e6), *rows_at(60, 3, **LOST)]
    assert [edge.is_high for edge in panel_of(curves(parsed(rows), "goodput_bit_s")).edges] == [False]


def test_cross_of_a_condition_without_valid_repeats_shows_the_status_counts() -> None:
    rows = [*rows_at(10), *rows_at(20), *rows_at(60, 2, status="failed", reason="no answer")]
    assert [edge.text for edge in panel_of(curves(parsed(rows), "rtt_median_s")).edges] == [
        "no valid repeat: 2 failed"
    ]


def test_point_shows_the_number_of_repeats_with_a_value() -> None:
    partial_rows = [*rows_at(20, 2), lawns.row(3, distance="20m", distance_m=20.0, **LOST)]
    (chart,) = curves(parsed([*rows_at(10), *partial_rows]), "rtt_median_s")
    assert list(chart.panels[0].series[0].notes) == ["", "2 of 3"]
    assert "the number of valid repeats with a value" in chart.caption


def test_line_is_broken_at_missing_values_and_very_wide_intervals() -> None:
    measured_rows = [row for metres in (10, 20, 30, 40) for row in rows_at(metres)]
    (series,) = panel_of(curves(parsed(measured_rows), "rtt_median_s")).series
    assert (series.join, set(series.breaks)) == ("line", set())
    lost_rows = [*measured_rows, *rows_at(25, 2, **LOST)]
    (series,) = panel_of(curves(parsed(lost_rows), "rtt_median_s")).series
    assert set(series.breaks) == {1}
    # The interval of two very different repeats covers the whole axis.
    wide_rows = [
        *measured_rows,
        *(replace(row, rtt_median_s=0.001 + 0.03 * n) for n, row in enumerate(rows_at(25, 2))),
    ]
    (series,) = panel_of(curves(parsed(wide_rows), "rtt_median_s")).series
    assert set(series.breaks) == {1, 2}


@pytest.mark.parametrize("form", ["svg", "png"])
def test_a_figure_of_one_layout_equals_a_figure_that_matplotlib_lays_out_twice(
    form: Format, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y = [1.0, 2.0, 3.0], [0.5, 20.0, 3000.0]
    series = [Series("sent", Style("blue", "o"), x, y), Series("received", Style("red", "s"), x, y)]
    panel = Panel("a long title that needs several lines in a figure of one column", "distance", "ms", series, "")
    chart = Chart("a", "A", "", [panel])
    figure = figures.paper(chart, form)
    monkeypatch.setattr(figures, "_Figure", Figure)
    assert figures.paper(chart, form) == figure


def test_broken_line_is_drawn_in_segments() -> None:
    def lines(breaks: set[int]) -> int:
        series = Series("", Style("blue", "o"), [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0], breaks=breaks)
        return figures.panel_svg(Panel("", "", "", [series], "", top=4.0)).count("stroke-width: 1.4")

    assert lines({1}) == lines(set()) + 1
    assert lines({0, 1, 2}) == 0


def test_quantities_of_one_distance_are_dots_not_curves() -> None:
    repeats = parsed(rows_at(10, 3, goodput_bit_s=2e6))
    report = build_contents(repeats, title="", repeat="", command=["fieldkit"])
    assert report.against_distance == []
    (chart,) = dot_charts(repeats)
    assert chart.title == "All quantities at 10m"
    lanes = {panel.x_label: list(panel.lanes) for panel in chart.panels}
    assert lanes == {
        "share [%]": ["UDP datagram loss"],
        "time [ms]": ["transfer time", "RTT"],
        "rate [Mbit/s]": ["goodput"],
    }
    (_, times, _) = chart.panels
    (series,) = times.series
    assert sorted(series.x) == pytest.approx([10.1, 500.0])
    assert len(series.behind) == 6
    assert times.x_log
    assert "quantities" in [section.name for section in report.sections]


def test_one_distance_per_topology_is_not_a_curve() -> None:
    repeats = parsed([*rows_at(10, 3), *rows_at(20, 3, topology="masterless")])
    assert curves(repeats, "rtt_median_s") == []
    (chart,) = dot_charts(repeats)
    assert {panel.title for panel in chart.panels} == {"UDP, master, 10m", "UDP, masterless, 20m"}


def test_several_distances_are_curves_not_dots() -> None:
    assert dot_charts(parsed([*rows_at(10), *rows_at(20)])) == []


def test_lane_of_a_condition_without_arrivals_has_a_cross() -> None:
    lost_rows = rows_at(10, 2, scenario="nlos", procedure="nlos", **LOST)
    times = next(
        panel for panel in dot_charts(parsed([*rows_at(10), *lost_rows]))[0].panels if "time" in panel.x_label
    )
    assert [edge.text for edge in times.edges] == ["nothing arrived: 2 of 2"] * 2
    assert [round(edge.at) for edge in times.edges] == [1, 0] or [round(edge.at) for edge in times.edges] == [0, 1]


@given(st.lists(st.floats(1e-6, 1e6), min_size=1))
def test_axis_is_logarithmic_over_more_than_1_5_decades(values: list[float]) -> None:
    decades = math.log10(max(values)) - math.log10(min(values))
    if abs(decades - 1.5) > 1e-9:
        assert needs_log(values) is (decades > 1.5)
    assert not needs_log([0.0, *values])
    assert not needs_log([-1.0, *values])


@pytest.mark.parametrize(("longest_s", "is_log"), [(0.02, False), (2.0, True)])
def test_axis_of_a_distribution_is_logarithmic_for_a_wide_range(longest_s: float, is_log: bool) -> None:
    rows = rows_at(10, 4)
    rows[-1] = replace(rows[-1], rtt_median_s=longest_s)
    repeats = parsed(rows)
    cells = aggregate(repeats)
    chart = next(iter(distribution.charts(cells, Identities(cells), load_evidence(repeats))))
    assert chart.panels[0].x_log is is_log
    assert ("logarithmic" in chart.caption) is is_log
    assert chart.panels[0].left == (pytest.approx(10 / 1.1) if is_log else 0)


def test_flag_is_drawn_as_a_share_of_repeats(tmp_path: Path) -> None:
    columns = trial_columns(outage_columns.fault_columns(FaultKind.REBOOT))
    name = fault_column_name(FaultKind.REBOOT, "recovered")
    rows = [{**row, name: n > 1} for metres in (10, 20) for n, row in enumerate(rows_at(metres, 4))]
    path = tmp_path / "trial.csv"
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    (chart,) = curves(read([path], columns), name)
    assert chart.caption == "Share of the valid repeats in which it is true, with its 95 % interval."
    assert chart.panels[0].y_label == "Reachable after reboot [% of repeats]"
    assert chart.panels[0].series[0].behind == []


def test_distances_have_the_labels_that_the_operator_typed() -> None:
    rows = [*rows_at(10), *(replace(row, distance="60ft") for row in rows_at(18.288))]
    panel = panel_of(curves(parsed(rows), "rtt_median_s"))
    assert [label for _, label in panel.x_ticks] == ["10m", "60ft"]
    assert "at 60ft" in panel.description


def test_a_long_name_of_a_lane_has_two_lines() -> None:
    series = Series("", Style("blue", "o", "none"), [1.0, 2.0], [0.0, 1.0], join="none")
    lanes = ("ping recovery after link-down", "a name " + 10 * "that is too long ")
    figure = figures.panel_svg(Panel("", "", "", [series], "", top=3.0, right=3.0, lanes=lanes))
    texts = re.findall(r">([^<>]+)</(?:text|tspan)>", figure)
    assert {"ping recovery after", "link-down", "a name that is too long"} <= set(texts)
    assert sum("that is too long" in text for text in texts) == 2
    assert texts.count("that is too long that is…") == 1


@pytest.mark.parametrize("lanes", [(), ("RTT",)])
@pytest.mark.parametrize("is_high", [True, False])
def test_a_cross_is_drawn_with_its_text(lanes: tuple[str, ...], is_high: bool) -> None:
    edge = EdgeMark(0.0, "nothing arrived: 3 of 3", "blue", is_high)
    series = Series("", Style("blue", "o", "none"), [1.0], [0.0], [0.5], [2.0], join="none")
    figure = figures.panel_svg(Panel("", "", "", [series], "", top=3.0, right=3.0, lanes=lanes, edges=[edge]))
    assert "nothing arrived: 3 of 3" in figure


def test_lower_bound_is_an_open_marker_that_breaks_the_line(tmp_path: Path) -> None:
    columns = trial_columns((*ping_gaps.GAP_COLUMNS, *ping_gaps.OPEN_GAP_COLUMNS))
    rows = [
        {
            **row,
            "rtt_gap_s": None if metres == 40 and n else 0.1,
            "rtt_gap_at_least_s": 2.0 if metres == 40 and n else None,
        }
        for metres in (10, 20, 30, 40, 50)
        for n, row in enumerate(rows_at(metres, 6))
    ]
    path = tmp_path / "trial.csv"
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    (chart,) = curves(read([path], columns), "rtt_gap_s")
    (series,) = chart.panels[0].series
    assert list(series.bounds) == [False, False, False, True, False]
    assert [y for _, y in series.behind_bounds] == [2000.0] * 5
    assert series.high[3] is None
    assert series.notes[3] == "5 of 6 not ended"
    assert {2, 3} <= set(series.breaks)
    assert "a lower bound" in chart.caption
    figure = figures.panel_svg(chart.panels[0])
    panel_without_bounds = without_bounds(chart.panels[0])
    assert figure.count("<path") > figures.panel_svg(panel_without_bounds).count("<path")


def without_bounds(panel: Panel) -> Panel:
    """Return the panel without marks of lower bounds."""
    series = [dataclasses.replace(curve, bounds=()) for curve in panel.series]
    return dataclasses.replace(panel, series=series)
