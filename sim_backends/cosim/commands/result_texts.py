"""Labels and texts for study results, shared by tables and figures."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from sim_backends.cosim.studies.local_errors import LocalErrors

BIAS_LABELS: Final[Mapping[str, tuple[str, float]]] = MappingProxyType(
    {
        "loss": ("packets lost (%)", 100.0),
        "delay_s": ("delay (ms)", 1e3),
        "apart_m": ("agent distance (m)", 1.0),
    }
)
"""For each measure of a bias: its label, and the factor from SI units to the label's unit."""


def order_text(errors: LocalErrors, measure: str) -> str:
    """Return the order of convergence of an error with its interval, `1.00 [0.98, 1.03]`.

    The text is empty if the order is unknown, and has no interval if the interval is unknown.
    """
    order = errors.order(measure)
    if math.isnan(order.value):
        return ""
    interval = "" if math.isnan(order.low) else f" [{order.low:.2f}, {order.high:.2f}]"
    return f"{order.value:.2f}{interval}"
