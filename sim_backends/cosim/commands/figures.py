"""The figures of studies."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.report.theme import Format
from sim_backends.cosim import plots
from sim_backends.cosim.commands import orders
from sim_backends.cosim.commands.bias import LABELS
from sim_backends.cosim.plots import Curve, LogPanel
from sim_backends.cosim.studies.bias import Bias
from sim_backends.cosim.studies.intervals import IntervalEstimate
from sim_backends.cosim.studies.local_errors import LocalErrors
from sim_backends.cosim.studies.shootout import Row

_LOCAL: Final = {
    "delivery_s": ("Delivery time", "mean error (ms)", 1e3),
    "late_s": ("Arrivals in the past", "mean lateness (ms)", 1e3),
    "position_m": ("Assumed position", "mean error (mm)", 1e3),
    "path_m": ("Path of the agents", "mean error (mm)", 1e3),
    "fates": ("Other fate", "packets (%)", 100.0),
}
"""Title, label and factor of the panel of each local error."""


@dataclass(frozen=True)
class CostPoint:
    """The errors and the cost of a policy with a window; nan for an error that no packet determines.

    Attributes:
        policy: Its name.
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


def error_against_cost(points: Sequence[CostPoint], growth: LogPanel | None = None) -> Callable[[Format], bytes]:
    """Return a function that draws errors against exchanges per simulated second, a curve per policy.

    Args:
        points: The points.
        growth: An additional panel, or None.
    """
    shown = [
        ("Delivery time", "mean error (ms)", "delivery_error_mean_s"),
        ("Position", "mean error (mm)", "position_error_mean_m"),
    ]
    if any(point.path_error_max_m > 0 for point in points):
        shown.append(("Path of the agents", "largest error (mm)", "path_error_max_m"))
    panels = [
        LogPanel(title, "exchanges per simulated second", label, _curves(points, name))
        for title, label, name in shown
    ]
    panels += [] if growth is None else [growth]
    return lambda form: plots.log_figure(panels, form)


def growth(rows: Iterable[Row], title: str) -> LogPanel | None:
    """Return a panel of the distance of agents from the reference's path over time; None if there is none.

    Args:
        rows: The results of the policies; exact policies, which have no such distance, are omitted.
        title: Title of the runs.
    """
    curves = []
    for row in rows:
        times_s, distances_m = row.growth_m
        if distances_m.any():
            first = int(np.flatnonzero(distances_m)[0])
            curves.append(Curve(row.policy, times_s[first:].tolist(), (distances_m[first:] * 1e3).tolist()))
    if not curves:
        return None
    return LogPanel(f"Off the reference's path, {title}", "time (s)", "largest (mm)", curves, over_time=True)


def error_against_window(by_policy: Mapping[str, LocalErrors]) -> Callable[[Format], bytes]:
    """Return a function that draws local errors against the window: a panel per error, a curve per policy."""
    panels = []
    for measure, (title, label, factor) in _LOCAL.items():
        curves = [
            Curve(name, x, y, f"{name}\norder {orders.order_text(errors, measure)}")
            for name, errors in by_policy.items()
            if len((points := _positive_points(errors, measure, factor))[0]) > 1
            for x, y in (points,)
        ]
        if curves:
            panels.append(LogPanel(title, "window (ms)", label, curves, labels_at_right=True))
    return lambda form: plots.log_figure(panels, form)


def bias_of_policies(by_policy: Mapping[str, Mapping[str, Bias]]) -> Callable[[Format], bytes]:
    """Return a function that draws the bias of each policy with its interval, a panel per measure."""
    panels = {
        label: {policy: _scaled(measures[name].bias, factor) for policy, measures in by_policy.items()}
        for name, (label, factor) in LABELS.items()
    }
    return lambda form: plots.interval_figure(panels, form)


def _scaled(bias: IntervalEstimate, factor: float) -> tuple[float, float, float]:
    return bias.value * factor, bias.low * factor, bias.high * factor


def _positive_points(errors: LocalErrors, measure: str, factor: float) -> tuple[list[float], list[float]]:
    """Return the windows in ms and the scaled errors, without windows that had no error."""
    pairs = zip(errors.window_s.mean(axis=1) * 1e3, errors.mean(measure) * factor, strict=True)
    points = [(float(x), float(y)) for x, y in pairs if y > 0]
    return [x for x, _ in points], [y for _, y in points]


def _curves(points: Sequence[CostPoint], name: str) -> list[Curve]:
    """Return a curve per policy, of values times 1000; errors that no packet determines are omitted."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        if not math.isnan(error := getattr(point, name)):
            curves.setdefault(point.policy, []).append((point.exchanges_per_s, error * 1e3))
    return [Curve(name, [x for x, _ in points], [y for _, y in points]) for name, points in curves.items()]
