"""What the figures of studies show."""

import math
from collections.abc import Callable, Sequence

from fieldkit.report.theme import Format
from sim_backends.cosim import plots
from sim_backends.cosim.comparison import Errors
from sim_backends.cosim.plots import Curve, LogPanel
from sim_backends.cosim.studies.shootout import Row


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


def _curves(found: Sequence[tuple[float, Row]], value: Callable[[Errors], float]) -> list[Curve]:
    """Return a curve per policy; an error that no packet tells has no point."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for _, row in found:
        if row.errors is not None and not math.isnan(error := value(row.errors)):
            curves.setdefault(row.policy, []).append((row.errors.exchanges_per_s, error))
    return [Curve(name, [x for x, _ in points], [y for _, y in points]) for name, points in curves.items()]
