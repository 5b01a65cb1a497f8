"""The command `fieldkit cosim plot`, and the figures of studies."""

import argparse
import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.cli.display import show_note
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.report.theme import Format
from sim_backends.cosim import plots
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.replay import recording_at, scenario_of, title_of
from sim_backends.cosim.commands.result_texts import BIAS_LABELS, order_text
from sim_backends.cosim.plot_layout import Curve, FlowTrace, LogPanel, ObstacleOutline, outlines
from sim_backends.cosim.plots import run_figure
from sim_backends.cosim.recording.replay import Recording
from sim_backends.cosim.studies.intervals import IntervalEstimate
from sim_backends.cosim.studies.local_errors import LocalErrors
from sim_backends.cosim.studies.shootout import Bias, Row
from sim_backends.world.world import load_world

_LOCAL_ERRORS: Final = {
    "delivery_s": ("Delivery time", "mean error (ms)", 1e3),
    "late_s": ("Arrivals in the past", "mean lateness (ms)", 1e3),
    "position_m": ("Assumed position", "mean error (mm)", 1e3),
    "path_m": ("Path of the agents", "mean error (mm)", 1e3),
    "fates": ("Lost in only one run", "packets (%)", 100.0),
}
"""Title, label and factor of the panel of each local error."""


@dataclass(frozen=True)
class CostPoint:
    """The errors and the cost of a policy, with one window; an error is nan if there are no packets to measure it.

    Attributes:
        policy: Name of the policy.
        exchanges_per_s: Exchanges per simulated second.
        delivery_error_mean_s: Mean error of delivery times.
        position_error_mean_m: Mean error of the positions that the network assumes.
        path_error_max_m: Largest error of the positions of agents.
    """

    policy: str
    exchanges_per_s: float
    delivery_error_mean_s: float
    position_error_mean_m: float
    path_error_max_m: float


def cost_points(rows: Iterable[Row]) -> list[CostPoint]:
    """Return the points of the policies that could be run."""
    return [
        CostPoint(
            row.policy,
            row.errors.exchanges_per_s,
            row.errors.delivery_error_s.mean,
            row.errors.position_error_m.mean,
            row.errors.path_error_m.largest,
        )
        for row in rows
        if row.errors is not None
    ]


def error_against_cost(
    points: Sequence[CostPoint], growth_panel: LogPanel | None = None
) -> Callable[[Format], bytes]:
    """Return a function that draws errors against exchanges per simulated second, a curve per policy.

    Args:
        points: The points.
        growth_panel: An additional panel, or None.
    """
    panel_specs = [
        ("Delivery time", "mean error (ms)", "delivery_error_mean_s"),
        ("Position", "mean error (mm)", "position_error_mean_m"),
    ]
    if any(point.path_error_max_m > 0 for point in points):
        panel_specs.append(("Path of the agents", "largest error (mm)", "path_error_max_m"))
    panels = [
        LogPanel(title, "exchanges per simulated second", label, _curves(points, name))
        for title, label, name in panel_specs
    ]
    panels += [] if growth_panel is None else [growth_panel]
    return lambda form: plots.log_figure(panels, form)


def growth_panel(rows: Iterable[Row], title: str) -> LogPanel | None:
    """Return a panel of the distance of agents from the reference's path over time; None if all distances are 0.

    Args:
        rows: The results of the policies; those whose distances are all 0, such as exact policies, are omitted.
        title: Title of the runs.
    """
    curves = []
    for row in rows:
        times_s, distances_m = row.growth
        if distances_m.any():
            first = int(np.flatnonzero(distances_m)[0])
            curves.append(Curve(row.policy, times_s[first:].tolist(), (distances_m[first:] * 1e3).tolist()))
    if not curves:
        return None
    return LogPanel(
        f"Distance from the reference's path, {title}", "time (s)", "largest (mm)", curves, over_time=True
    )


def error_against_window(by_policy: Mapping[str, LocalErrors]) -> Callable[[Format], bytes] | None:
    """Return a function that draws local errors against the window: a panel per error, a curve per policy.

    The result is None if no policy has errors above 0 with at least two windows.
    """
    panels = []
    for measure, (panel_title, label, factor) in _LOCAL_ERRORS.items():
        curves = []
        for name, errors in by_policy.items():
            windows_ms, values = _positive_points(errors, measure, factor)
            if len(windows_ms) > 1:
                curves.append(Curve(name, windows_ms, values, f"{name}\norder {order_text(errors, measure)}"))
        if curves:
            panels.append(LogPanel(panel_title, "window (ms)", label, curves, labels_at_right=True))
    if not panels:
        return None
    return lambda form: plots.log_figure(panels, form)


def bias_of_policies(by_policy: Mapping[str, Mapping[str, Bias]]) -> Callable[[Format], bytes]:
    """Return a function that draws the bias of each policy with its interval, a panel per measure."""
    panels = {
        label: {policy: _scaled(measures[name].bias, factor) for policy, measures in by_policy.items()}
        for name, (label, factor) in BIAS_LABELS.items()
    }
    return lambda form: plots.interval_figure(panels, form)


def _scaled(bias: IntervalEstimate, factor: float) -> tuple[float, float, float]:
    return bias.value * factor, bias.low * factor, bias.high * factor


def _positive_points(errors: LocalErrors, measure: str, factor: float) -> tuple[list[float], list[float]]:
    """Return the windows in ms and the scaled errors, without windows whose error is 0."""
    pairs = zip(errors.window_s.mean(axis=1) * 1e3, errors.mean(measure) * factor, strict=True)
    points = [(float(x), float(y)) for x, y in pairs if y > 0]
    return [x for x, _ in points], [y for _, y in points]


def _curves(points: Sequence[CostPoint], name: str) -> list[Curve]:
    """Return a curve per policy, with the errors in ms or mm; errors that are nan are omitted."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        if not math.isnan(error := getattr(point, name)):
            curves.setdefault(point.policy, []).append((point.exchanges_per_s, error * 1e3))
    return [Curve(name, [x for x, _ in points], [y for _, y in points]) for name, points in curves.items()]


_REMEDY: Final = "write one with fieldkit cosim shootout SCENARIO --format csv > shootout.csv"


def run(arguments: argparse.Namespace) -> int:
    """Draw a recording, or the table of a shootout."""
    draw = settings.open_figure(arguments.out, "--out")
    if arguments.recording.suffix == ".csv":
        draw(error_against_cost(_points(arguments.recording)))
        return 0
    recording = recording_at(arguments.recording)
    obstacles = _obstacles(recording)
    draw(lambda form: run_figure(title_of(recording), _paths_m(recording), _traces(recording), form, obstacles))
    return 0


def _points(path: Path) -> list[CostPoint]:
    """Return the points of a table of `fieldkit cosim shootout --format csv`; rows without numbers are ignored.

    Raises:
        EvidenceError: The file is not such a table, or has no row with numbers.
    """
    names = [field.name for field in fields(CostPoint)][1:]
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            points = [
                CostPoint(row["policy"], *(_magnitude(row[name]) for name in names)) for row in csv.DictReader(file)
            ]
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise EvidenceError(
            f"this is not the table of a shootout: {type(error).__name__}: {error}", where=str(path), remedy=_REMEDY
        ) from error
    points = [point for point in points if point.exchanges_per_s > 0]
    if not points:
        raise EvidenceError("no policy has numbers in this table", where=str(path), remedy=_REMEDY)
    return points


_MAGNITUDES: Final = (1e-30, 1e30)
"""Smallest and largest number that a table of a shootout can contain, except 0."""


def _magnitude(text: str | None) -> float:
    """Return an error or a cost in a table of a shootout; nan for an empty cell.

    Raises:
        ValueError: The text is not a number, or not an error or a cost.
    """
    value = float(text or math.nan)
    low, high = _MAGNITUDES
    if not (math.isnan(value) or value == 0 or low <= value <= high):
        raise ValueError(f"{text!r} is neither an error nor a cost")
    return value


def _obstacles(recording: Recording) -> list[ObstacleOutline]:
    """Return the outlines of the obstacles in the world of a run.

    If the world does not exist, show a note and return an empty list.
    """
    name = scenario_of(recording).world
    try:
        return list(outlines(load_world(name)))
    except ConfigurationError as error:
        show_note(f"drawn without obstacles: {error.located}")
        return []


def _paths_m(recording: Recording) -> dict[str, list[tuple[float, float]]]:
    paths_m: dict[str, list[tuple[float, float]]] = {}
    for _, agent, state in recording.states:
        paths_m.setdefault(agent, []).append(state.position_m[:2])
    return paths_m


def _traces(recording: Recording) -> list[FlowTrace]:
    """Return the packets of each flow over time, without packets whose fate is not decided."""
    flows: dict[str, list[tuple[float, float, float]]] = {}
    for fate in recording.run.fates.values():
        if fate.is_decided:
            arrived_ns = fate.arrived_ns
            delay_s = math.nan if arrived_ns is None else (arrived_ns - fate.packet.enters_ns) / 1e9
            distance_m = math.dist(fate.true_states[0].position_m, fate.true_states[1].position_m)
            flows.setdefault(fate.packet.identity[0], []).append((fate.packet.sent_ns / 1e9, delay_s, distance_m))
    return [FlowTrace(name, *zip(*sorted(flows[name]), strict=True)) for name in sorted(flows)]
