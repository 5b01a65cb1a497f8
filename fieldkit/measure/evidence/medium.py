"""Delays of packets on the air, noted by a transfer where its testbed knows them (`Oracle.delays`).

One line per number: `packets 215`, then the four parts summed over them, in integer nanoseconds.
"""

import re
from dataclasses import fields
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import DelayParts
from fieldkit.measure.evidence import reading

FILE: Final = laptop_files.MEDIUM

COLUMNS: Final = columns(
    30,
    (
        "delay_s",
        "s",
        (
            "Mean delay of the transfer's packets from sender to receiver, the sum of the paper's four parts (its "
            "eq. 2). Empty where nobody knows them, as in the field."
        ),
        Figure("air delay", Kind.MEDIAN, rank=34),
    ),
    ("delay_processing_s", "s", "Of delay_s, what the stations took."),
    ("delay_transmission_s", "s", "Of delay_s, what the packet's bits took at the rate of the link."),
    ("delay_propagation_s", "s", "Of delay_s, what the way took once they had left."),
    ("delay_queuing_s", "s", "Of delay_s, what the packet waited for others before it."),
    ("delay_packets", "count", "How many packets delay_s is the mean of: those that were delivered."),
)

_NAMES: Final = tuple(item.name for item in fields(DelayParts))
# 18 digits of nanoseconds are 31 years.
_FILE: Final = re.compile("".join(rf"{name} ([0-9]{{1,18}})\n" for name in _NAMES) + r"\Z")


def read(path: Path) -> DelayParts:
    """Return what stands in the file.

    Raises:
        EvidenceError: It is missing or not whole, or packets took time of which there are none.
    """
    match = _FILE.match(reading.text(path))
    if match is None:
        raise EvidenceError("does not say what packets were delayed by", where=str(path))
    parts = DelayParts(**dict(zip(_NAMES, map(int, match.groups()), strict=True)))
    if not parts.packets and total_ns(parts):
        raise EvidenceError("says that no packets took time", where=str(path))
    return parts


def total_ns(parts: DelayParts) -> int:
    """Return the sum of the four parts, in ns: the paper's eq. 2 over all packets."""
    return parts.processing_ns + parts.transmission_ns + parts.propagation_ns + parts.queuing_ns


def text(before: DelayParts, after: DelayParts) -> str:
    """Return what came to `before` until `after`, as `read` reads it."""
    return "".join(f"{name} {getattr(after, name) - getattr(before, name)}\n" for name in _NAMES)


def measure(parts: DelayParts | None) -> Measured:
    """Return the columns: means over the packets; None where nobody sees into the air."""
    if parts is None:
        return Measured.nothing(COLUMNS, "nobody sees into the air")
    scale = 1e9 * parts.packets
    values = {
        "delay_s": total_ns(parts) / scale if scale else None,
        "delay_processing_s": parts.processing_ns / scale if scale else None,
        "delay_transmission_s": parts.transmission_ns / scale if scale else None,
        "delay_propagation_s": parts.propagation_ns / scale if scale else None,
        "delay_queuing_s": parts.queuing_ns / scale if scale else None,
        "delay_packets": parts.packets,
    }
    return Measured.of(values, "no packet was delivered")
