"""What the figures of studies show."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from fieldkit.report.theme import Format
from sim_backends.cosim import plots
from sim_backends.cosim.commands import orders
from sim_backends.cosim.commands.bias import MEASURES
from sim_backends.cosim.comparison import Errors
from sim_backends.cosim.plots import Curve, LogPanel
from sim_backends.cosim.studies.bias import Bias
from sim_backends.cosim.studies.intervals import Estimate
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


def error_against_cost(found: Sequence[tuple[float, Row]]) -> Callable[[Format], bytes]:
    """Return what draws errors against exchanges per simulated second, a curve per policy over its windows."""
    panels = [
        LogPanel(title, "exchanges per simulated second", label, _curves(found, value))
        for title, label, value in (
            ("Delivery time", "mean error (ms)", lambda errors: errors.delivery_error_s.mean * 1e3),
            ("Position", "mean error (mm)", lambda errors: errors.position_error_m.mean * 1e3),
        )
    ]
    return lambda form: plots.log_figure(panels, form)


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


def _scaled(bias: Estimate, factor: float) -> tuple[float, float, float]:
    return bias.value * factor, bias.low * factor, bias.high * factor


def _seen(errors: LocalErrors, measure: str, factor: float) -> tuple[list[float], list[float]]:
    """Return the windows in ms, and the errors, where some error was seen."""
    pairs = zip(errors.window_s.mean(axis=1) * 1e3, errors.mean(measure) * factor, strict=True)
    found = [(float(x), float(y)) for x, y in pairs if y > 0]
    return [x for x, _ in found], [y for _, y in found]


def _curves(found: Sequence[tuple[float, Row]], value: Callable[[Errors], float]) -> list[Curve]:
    """Return a curve per policy; an error that no packet tells has no point."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for _, row in found:
        if row.errors is not None and not math.isnan(error := value(row.errors)):
            curves.setdefault(row.policy, []).append((row.errors.exchanges_per_s, error))
    return [Curve(name, [x for x, _ in points], [y for _, y in points]) for name, points in curves.items()]
