"""Delays that a testbed's oracle reports: lateness of deliveries, and air delay of a transfer's packets.

The lateness is that of deliveries during a repeat, in comparison with the radio model (`Oracle.lateness`). The air
delay has four components (`Oracle.delays`). Its file has one line per number: `packets 215`, then the components
summed over all packets, in integer nanoseconds.
"""

import re
from dataclasses import fields
from itertools import accumulate
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import DelayParts, Lateness
from fieldkit.measure.evidence import reading

LATENESS_FILE: Final = laptop_files.LATENESS

LATENESS_COLUMNS: Final = columns(
    50,
    (
        "emulator_late_p99_s",
        "s",
        (
            "99th percentile of the lateness with which packets were delivered to the robots, compared with the "
            "emulator's radio model, over the whole repeat; rounded up by at most an eighth. Empty for real radios."
        ),
    ),
    ("emulator_late_max_s", "s", "Largest lateness of these packets; see emulator_late_p99_s."),
    (
        "emulator_too_late",
        "count",
        "Packets later than emulated.late_bound of the site file; above 0 the repeat is void. Empty for real radios.",
    ),
)

# 18 digits of nanoseconds are 31 years.
_MAX_PACKETS: Final = 10**18
_LATENESS_TEXT: Final = re.compile(
    r"bound ([0-9]{1,18})(?: lines ([0-9]{1,9}))?\n((?:late [0-9]{1,18} [0-9]{1,18}\n)*)\Z"
)


def lateness_text(before: Lateness, after: Lateness) -> str:
    """Return the file text for the packets that were counted between `before` and `after`."""
    added = {late_ns: count - before.packets.get(late_ns, 0) for late_ns, count in sorted(after.packets.items())}
    lines = [f"late {late_ns} {count}\n" for late_ns, count in added.items() if count]
    return "".join((f"bound {after.bound_ns} lines {len(lines)}\n", *lines))


def read_lateness(path: Path) -> Lateness:
    """Return the lateness in a file.

    Raises:
        EvidenceError: The file is missing, truncated, or has other contents.
    """
    match = _LATENESS_TEXT.match(reading.text(path))
    if match is None:
        raise EvidenceError("is not a file of packet lateness", where=str(path))
    bound, line_count, body = match.groups()
    lines = body.splitlines()
    if line_count is not None and int(line_count) != len(lines):
        raise EvidenceError(f"has {len(lines)} lines of {line_count}: truncated", where=str(path))
    packets = {int(late_ns): int(count) for _, late_ns, count in map(str.split, lines)}
    if sum(packets.values()) >= _MAX_PACKETS:
        raise EvidenceError("contains an impossible number of packets", where=str(path))
    return Lateness(bound_ns=int(bound), packets=packets)


def lateness_quantile_ns(lateness: Lateness, share: float) -> int | None:
    """Return the quantile of the lateness at `share` (0 to 1) in ns; None if there are no packets."""
    counts = sorted((late_ns, count) for late_ns, count in lateness.packets.items() if count)
    cumulative = accumulate(count for _, count in counts)
    min_total = share * sum(count for _, count in counts)
    return next((late_ns for (late_ns, _), total in zip(counts, cumulative, strict=True) if total >= min_total), None)


def too_late(lateness: Lateness) -> int:
    """Return the number of packets that were later than the bound."""
    return sum(count for late_ns, count in lateness.packets.items() if late_ns > lateness.bound_ns)


def measure_lateness(lateness: Lateness | None) -> Measured:
    """Return the columns; `lateness` is None for real radios, or if the testbed cannot measure it."""
    if lateness is None:
        return Measured.all_missing(LATENESS_COLUMNS, "the radios are real")
    late_ns = {share: lateness_quantile_ns(lateness, share) for share in (0.99, 1.0)}
    values = {
        "emulator_late_p99_s": None if late_ns[0.99] is None else late_ns[0.99] / 1e9,
        "emulator_late_max_s": None if late_ns[1.0] is None else late_ns[1.0] / 1e9,
        "emulator_too_late": too_late(lateness),
    }
    return Measured.from_optional(values, "no packet was delivered")


def lateness_problem(lateness: Lateness) -> str | None:
    """Return the reason why the emulation did not follow its model, or None if it did."""
    late_ns = lateness_quantile_ns(lateness, 1.0)
    if late_ns is None or late_ns <= lateness.bound_ns:
        return None
    late = f"{too_late(lateness)} packets were delivered too late, by up to {late_ns / 1e6:.3g} ms"
    return f"{late}; the bound is {lateness.bound_ns / 1e6:g} ms"


AIR_DELAY_FILE: Final = laptop_files.MEDIUM

AIR_DELAY_COLUMNS: Final = columns(
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
_AIR_DELAY_TEXT: Final = re.compile("".join(rf"{name} ([0-9]{{1,18}})\n" for name in _NAMES) + r"\Z")


def read_air_delay(path: Path) -> DelayParts:
    """Return the delays in a file.

    Raises:
        EvidenceError: The file is missing, incomplete, or contains delays of 0 packets.
    """
    match = _AIR_DELAY_TEXT.match(reading.text(path))
    if match is None:
        raise EvidenceError("is not a file of packet delays", where=str(path))
    parts = DelayParts(**dict(zip(_NAMES, map(int, match.groups()), strict=True)))
    if not parts.packets and air_delay_ns(parts):
        raise EvidenceError("contains delays, but of 0 packets", where=str(path))
    return parts


def air_delay_ns(parts: DelayParts) -> int:
    """Return the sum of the four components in ns: the paper's eq. 2, summed over all packets."""
    return parts.processing_ns + parts.transmission_ns + parts.propagation_ns + parts.queuing_ns


def air_delay_text(before: DelayParts, after: DelayParts) -> str:
    """Return the file text for the packets that were delivered between `before` and `after`."""
    return "".join(f"{name} {getattr(after, name) - getattr(before, name)}\n" for name in _NAMES)


def measure_air_delay(parts: DelayParts | None) -> Measured:
    """Return the columns, means over the packets; `parts` is None if the testbed cannot measure the delay."""
    if parts is None:
        return Measured.all_missing(AIR_DELAY_COLUMNS, "the testbed cannot measure the delay on the air")
    scale = 1e9 * parts.packets
    values = {
        "delay_s": air_delay_ns(parts) / scale if scale else None,
        "delay_processing_s": parts.processing_ns / scale if scale else None,
        "delay_transmission_s": parts.transmission_ns / scale if scale else None,
        "delay_propagation_s": parts.propagation_ns / scale if scale else None,
        "delay_queuing_s": parts.queuing_ns / scale if scale else None,
        "delay_packets": parts.packets,
    }
    return Measured.from_optional(values, "no packet was delivered")
