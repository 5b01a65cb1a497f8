"""What the figures of studies show."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.report.theme import Format
from sim_backends.cosim import plots
from sim_backends.cosim.commands import orders
from sim_backends.cosim.commands.bias import MEASURES
from sim_backends.cosim.plots import Curve, LogPanel
from sim_backends.cosim.studies.bias import Bias
from sim_backends.cosim.studies.intervals import IntervalEstimate
from sim_backends.cosim.studies.local_errors import LocalErrors
from sim_backends.cosim.studies.shootout import Row

_LOCAL: Final = {
    "delivery_s": ("Delivery time", "mean error (ms)", 1e3),
    "late_s": ("Arrivals told too late", "mean lateness (ms)", 1e3),
    "position_m": ("Position known", "mean error (mm)", 1e3),
    "path_m": ("Way of the agents", "mean error (mm)", 1e3),
    "fates": ("Other fate", "packets (%)", 100.0),
}
"""Title, label and factor of the panel of each local error."""


@dataclass(frozen=True)
class CostPoint:
    """How wrong a policy with a window is, and what that costs; nan for an error that no packet tells.

    Attributes:
        policy: Its name.
        exchanges_per_s: Per simulated second.
        delivery_error_mean_s: Of delivery times.
        position_error_mean_m: Of positions that the network knows.
        path_error_max_m: Of where agents are, the largest.
    """

    policy: str
    exchanges_per_s: float
    delivery_error_mean_s: float
    position_error_mean_m: float
    path_error_max_m: float


def cost_points(found: Iterable[Row]) -> list[CostPoint]:
    """Return the points of those policies that could be run."""
    return [
        CostPoint(
            row.policy,
            row.errors.exchanges_per_s,
            row.errors.delivery_error_s.mean,
            row.errors.position_error_m.mean,
            row.errors.path_error_m.largest,
        )
        for row in found
        if row.errors is not None
    ]


def error_against_cost(points: Sequence[CostPoint], growth: LogPanel | None = None) -> Callable[[Format], bytes]:
    """Return what draws errors against exchanges per simulated second, a curve per policy over its windows.

    Args:
        points: What is drawn.
        growth: A panel beside it.
    """
    shown = [
        ("Delivery time", "mean error (ms)", "delivery_error_mean_s"),
        ("Position", "mean error (mm)", "position_error_mean_m"),
    ]
    if any(point.path_error_max_m > 0 for point in points):
        shown.append(("Way of the agents", "largest error (mm)", "path_error_max_m"))
    panels = [
        LogPanel(title, "exchanges per simulated second", label, _curves(points, name))
        for title, label, name in shown
    ]
    panels += [] if growth is None else [growth]
    return lambda form: plots.log_figure(panels, form)


def growth(found: Iterable[Row], words: str) -> LogPanel | None:
    """Return a panel of how far agents are off the reference's way over time; None where they stay on it.

    Args:
        found: The policies; exact ones, which stay on it, are left out.
        words: With what they were run.
    """
    curves = []
    for row in found:
        times_s, apart_m = row.growth_m
        if apart_m.any():
            begun = int(np.flatnonzero(apart_m)[0])
            curves.append(Curve(row.policy, times_s[begun:].tolist(), (apart_m[begun:] * 1e3).tolist()))
    if not curves:
        return None
    return LogPanel(f"Off the reference's way, {words}", "time (s)", "largest (mm)", curves, over_time=True)


def error_against_window(found: Mapping[str, LocalErrors]) -> Callable[[Format], bytes]:
    """Return what draws local errors against the window, with the order of each policy; a panel per error seen."""
    panels = []
    for measure, (title, label, factor) in _LOCAL.items():
        curves = [
            Curve(name, x, y, f"{name}\norder {orders.in_words(errors, measure)}")
            for name, errors in found.items()
            if len((seen := _seen(errors, measure, factor))[0]) > 1
            for x, y in (seen,)
        ]
        if curves:
            panels.append(LogPanel(title, "window (ms)", label, curves, aside=True))
    return lambda form: plots.log_figure(panels, form)


def bias_of_policies(found: Mapping[str, Mapping[str, Bias]]) -> Callable[[Format], bytes]:
    """Return what draws the bias of each policy with its interval, a panel per measure."""
    panels = {
        words: {policy: _scaled(measures[name].bias, factor) for policy, measures in found.items()}
        for name, (words, factor) in MEASURES.items()
    }
    return lambda form: plots.interval_figure(panels, form)


def _scaled(bias: IntervalEstimate, factor: float) -> tuple[float, float, float]:
    return bias.value * factor, bias.low * factor, bias.high * factor


def _seen(errors: LocalErrors, measure: str, factor: float) -> tuple[list[float], list[float]]:
    """Return the windows in ms, and the errors, where some error was seen."""
    pairs = zip(errors.window_s.mean(axis=1) * 1e3, errors.mean(measure) * factor, strict=True)
    found = [(float(x), float(y)) for x, y in pairs if y > 0]
    return [x for x, _ in found], [y for _, y in found]


def _curves(points: Sequence[CostPoint], name: str) -> list[Curve]:
    """Return a curve per policy, of values in thousandths; an error that no packet tells has no point."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        if not math.isnan(error := getattr(point, name)):
            curves.setdefault(point.policy, []).append((point.exchanges_per_s, error * 1e3))
    return [Curve(name, [x for x, _ in points], [y for _, y in points]) for name, points in curves.items()]
