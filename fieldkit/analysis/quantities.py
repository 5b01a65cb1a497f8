"""Quantities: columns of trial.csv that are put together over repeats, and the way in which each is."""

from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from fieldkit.core.columns import of_fault
from fieldkit.core.model import FaultKind
from fieldkit.core.units import BITS_PER_S_PER_UNIT, FRACTION_PER_UNIT, SECONDS_PER_UNIT


class Kind(StrEnum):
    """How the repeats of a cell make one number.

    `counted`: a share of things counted over all repeats, each lost or not; `mean`: the mean of a share per repeat;
    `median`: the median of a time or rate per repeat; `flag`: the share of the repeats for which it is true.
    """

    COUNTED = "counted"
    MEAN = "mean"
    MEDIAN = "median"
    FLAG = "flag"


@dataclass(frozen=True)
class Quantity:
    """A column of trial.csv that figures are made of.

    Attributes:
        name: The column.
        label: In words, for tables and axes.
        kind: How repeats are put together.
        arrived: Column that counts what arrived; None unless counted.
        sent: Column that counts of how many; None unless counted.
        unit: `s`, `bit/s`, or `share` for what has none.
    """

    name: str
    label: str
    kind: Kind
    arrived: str | None = None
    sent: str | None = None
    unit: str = "share"

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns that it is made of, itself first."""
        return tuple(name for name in (self.name, self.arrived, self.sent) if name is not None)


def _time(name: str, label: str) -> Quantity:
    return Quantity(name, label, Kind.MEDIAN, unit="s")


def _rate(name: str, label: str) -> Quantity:
    return Quantity(name, label, Kind.MEDIAN, unit="bit/s")


QUANTITIES: Final = (
    Quantity("ip_loss", "IP packet loss", Kind.COUNTED, "ip_packets_received", "ip_packets_sent"),
    Quantity("datagram_loss", "UDP datagram loss", Kind.COUNTED, "datagrams_received", "datagrams_sent"),
    Quantity("tcp_byte_loss", "TCP bytes lost and repaired", Kind.MEAN),
    Quantity("byte_loss", "payload bytes lost", Kind.MEAN),
    Quantity("file_loss", "file bytes lost", Kind.MEAN),
    Quantity("paper_loss", "loss as the paper counts", Kind.COUNTED, "paper_received", "paper_packets"),
    Quantity("rtt_loss", "echo loss", Kind.COUNTED, "rtt_received", "rtt_sent"),
    _time("rtt_median_s", "RTT"),
    _time("one_way_median_s", "one-way delay"),
    _time("delay_variation_median_s", "delay variation"),
    _time("jitter_s", "jitter"),
    _time("delay_s", "delay on the air"),
    _time("transfer_s", "transfer time"),
    _rate("goodput_bit_s", "goodput"),
    _rate("throughput_bit_s", "throughput"),
    *(Quantity(of_fault(kind, "recovered"), f"back after {kind}", Kind.FLAG) for kind in FaultKind),
    *(_time(of_fault(kind, "recovery_s"), f"recovery from {kind}") for kind in FaultKind),
)
"""In the order in which tables show them."""

LOSSES: Final = ("datagram_loss", "tcp_byte_loss", "ip_loss", "file_loss", "rtt_loss")
"""Losses, what says most of a transfer first."""

BY_NAME: Final = MappingProxyType({one.name: one for one in QUANTITIES})

PER_UNIT: Final = MappingProxyType({"share": FRACTION_PER_UNIT, "s": SECONDS_PER_UNIT, "bit/s": BITS_PER_S_PER_UNIT})
"""How people write amounts of quantities: of each unit the symbols, with their factors."""

DEFAULT_BY: Final = ("procedure", "scenario", "topology", "backend", "distance", "distance_m", "protocol")
"""Columns that tell one condition from another."""
