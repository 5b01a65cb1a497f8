"""Air delay of a transfer's packets in four components, if its testbed can measure it (`Oracle.delays`).

One line per number: `packets 215`, then the four components summed over all packets, in integer nanoseconds.
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
            "Mean one-way delay of the transfer's packets, the sum of the four components of the paper's eq. 2. "
            "Empty if the testbed cannot measure it, as in the field."
        ),
        Figure("air delay", Kind.MEDIAN, rank=34),
    ),
    ("delay_processing_s", "s", "Part of delay_s: processing in the stations."),
    ("delay_transmission_s", "s", "Part of delay_s: transmission of the packet's bits at the rate of the link."),
    ("delay_propagation_s", "s", "Part of delay_s: propagation on the medium."),
    ("delay_queuing_s", "s", "Part of delay_s: waiting for earlier packets."),
    ("delay_packets", "count", "Number of packets of which delay_s is the mean: those that were delivered."),
)

_NAMES: Final = tuple(item.name for item in fields(DelayParts))
# 18 digits of nanoseconds are 31 years.
_FILE: Final = re.compile("".join(rf"{name} ([0-9]{{1,18}})\n" for name in _NAMES) + r"\Z")


def read(path: Path) -> DelayParts:
    """Return the delays in a file.

    Raises:
        EvidenceError: The file is missing, incomplete, or contains delays of 0 packets.
    """
    match = _FILE.match(reading.text(path))
    if match is None:
        raise EvidenceError("is not a file of packet delays", where=str(path))
    parts = DelayParts(**dict(zip(_NAMES, map(int, match.groups()), strict=True)))
    if not parts.packets and total_ns(parts):
        raise EvidenceError("contains delays, but of 0 packets", where=str(path))
    return parts


def total_ns(parts: DelayParts) -> int:
    """Return the sum of the four components in ns: the paper's eq. 2, summed over all packets."""
    return parts.processing_ns + parts.transmission_ns + parts.propagation_ns + parts.queuing_ns


def text(before: DelayParts, after: DelayParts) -> str:
    """Return the file text for the packets that were delivered between `before` and `after`."""
    return "".join(f"{name} {getattr(after, name) - getattr(before, name)}\n" for name in _NAMES)


def measure(parts: DelayParts | None) -> Measured:
    """Return the columns, means over the packets; `parts` is None if the testbed cannot measure the delay."""
    if parts is None:
        return Measured.all_missing(COLUMNS, "the testbed cannot measure the delay on the air")
    scale = 1e9 * parts.packets
    values = {
        "delay_s": total_ns(parts) / scale if scale else None,
        "delay_processing_s": parts.processing_ns / scale if scale else None,
        "delay_transmission_s": parts.transmission_ns / scale if scale else None,
        "delay_propagation_s": parts.propagation_ns / scale if scale else None,
        "delay_queuing_s": parts.queuing_ns / scale if scale else None,
        "delay_packets": parts.packets,
    }
    return Measured.from_optional(values, "no packet was delivered")
