"""The numbers of the paper's tables, as printed. LaTeX labels and section names are those of its source."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from fieldkit.core.model import Scenario as Sight
from sim_backends.cosim.studies.agreement import Printed

DISTANCES_M: Final = (20, 40, 60, 80, 100)
"""The distances of every table."""


class PrintedColumns(NamedTuple):
    """Two columns of a table: a number for each of `DISTANCES_M`.

    Attributes:
        delays_s: Sums of delays.
        losses: Shares lost.
    """

    delays_s: tuple[Printed, ...]
    losses: tuple[Printed, ...]


def _columns(delays_s: str, losses_percent: str) -> PrintedColumns:
    """Return columns from their digits.

    A delay of `1` is printed in columns with values such as `0.8`, and means `1.0`. All 40 losses are multiples of
    10 %, which is taken as their precision.
    """
    return PrintedColumns(
        tuple(Printed(text, step="" if "." in text else "0.1") for text in delays_s.split()),
        tuple(Printed(text, per_si=100, step="10") for text in losses_percent.split()),
    )


PRINTED: Final[Mapping[str, Mapping[tuple[Sight, str], PrintedColumns]]] = MappingProxyType(
    {
        # Section "Simulation Results", table `ugv`: masterless, UGV to UGV.
        "1": {
            (Sight.LOS, "topic"): _columns("0.01 0.1 0.4 0.4 0.6", "0 0 0 10 10"),
            (Sight.NLOS, "topic"): _columns("0.2 0.5 0.8 1 1", "0 10 10 20 30"),
        },
        # Section "Simulation Results", table `uav`: masterless, UGV to UAV.
        "2": {
            (Sight.LOS, "topic"): _columns("0.1 0.2 0.2 0.5 0.6", "0 10 10 20 30"),
            (Sight.NLOS, "topic"): _columns("0.5 0.7 0.8 1.3 1.6", "0 20 20 60 90"),
        },
        # Section "Discussion", table `ros1`: master-based, UGV to UGV.
        "3": {
            (Sight.LOS, "ros1-udp"): _columns("0.01 0.08 0.42 0.46 0.5", "0 0 10 30 40"),
            (Sight.LOS, "ros1"): _columns("0.01 0.1 0.48 0.6 0.8", "0 0 10 10 20"),
            (Sight.NLOS, "ros1-udp"): _columns("0.18 0.4 0.54 0.96 1", "10 30 50 60 60"),
            (Sight.NLOS, "ros1"): _columns("0.2 0.5 0.8 1 1.4", "10 10 30 40 50"),
        },
    }
)
"""The columns by table, and by line of sight and protocol."""

EMANE: Final[Mapping[str, tuple[Printed, Printed]]] = MappingProxyType(
    {
        "before": (Printed("5.377", per_si=1000), Printed("0", per_si=100)),
        "after": (Printed("54.309", per_si=1000), Printed("0", per_si=100)),
    }
)
"""Section "Discussion": mean round trip and share lost of 100 pings, before and after node 10 moved."""

FIXED: Final = "fixed window"
"""The paper's own system with a window that does not adapt."""
MASTER: Final = "master-based"
"""ROS 1, by TCP."""

CLAIMS: Final[Mapping[tuple[str, str], tuple[Printed, Printed]]] = MappingProxyType(
    {
        # Abstract and conclusion.
        (FIXED, "all"): (Printed("-12", per_si=100), Printed("-10", per_si=100)),
        # Abstract and introduction.
        (MASTER, "all"): (Printed("-12", per_si=100), Printed("-10", per_si=100)),
        # Sections "Simulation Results" and "Discussion".
        (MASTER, Sight.LOS): (Printed("-20", per_si=100), Printed("-10", per_si=100)),
        (MASTER, Sight.NLOS): (Printed("-40", per_si=100), Printed("-20", per_si=100)),
    }
)
"""Relative change of delay, and change of loss in percentage points, by compared system and lines."""
