"""Delays that a modelled radio reports: lateness of deliveries, and air delay of a transfer's packets.

The source of exact data about a modelled radio is called *oracle* (`backends.protocols.Oracle`).

A packet is late if it is delivered later than the radio model determines (`Oracle.lateness`). In a co-simulation,
physics and network run in windows of time, which can also be late, and the sync policy, which decides when the two
exchange data, adds to the delay of packets.

The air delay has four components (`Oracle.delays`). Its file has a line with the number of packets, `packets 215`,
and a line for each component, which is summed over all packets, in integer nanoseconds. The file of a co-simulation
has two more lines: the delay that is not divided into components, and the delay by the sync policy.
"""

import re
from collections.abc import Mapping
from dataclasses import fields
from itertools import accumulate
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import DelayParts, Lateness
from fieldkit.core.units import format_count
from fieldkit.measure.evidence import reading

LATENESS_FILE: Final = laptop_files.LATENESS

LATENESS_COLUMNS: Final = columns(
    50,
    (
        "emulator_late_p99_s",
        "s",
        (
            "99th percentile over the repeat of the time by which packets were delivered to the robots later than in "
            "the emulator's radio model; rounded up by at most an eighth. Empty for real radios."
        ),
    ),
    ("emulator_late_max_s", "s", "Largest such time over the repeat; see emulator_late_p99_s."),
    (
        "emulator_too_late",
        "count",
        (
            "Packets that were later than emulated.late_bound of the site file; if there are any, the repeat is "
            "void. Empty for real radios."
        ),
    ),
)

WINDOW_COLUMNS: Final = columns(
    150,
    (
        "cosim_late_p99_s",
        "s",
        (
            "99th percentile over the repeat of the time by which the results of a window of the co-simulation were "
            "later than the end of the window in real time; rounded up by at most an eighth. Empty without a "
            "co-simulation."
        ),
    ),
    (
        "cosim_late_max_s",
        "s",
        (
            "Largest such time over the repeat; see cosim_late_p99_s. If it is above emulated.late_bound of the site "
            "file, the repeat is void."
        ),
    ),
)

_MAX_PACKETS: Final = 10**18
# Times have at most 18 digits of nanoseconds, which are 31 years.
_LATENESS_TEXT: Final = re.compile(
    r"bound ([0-9]{1,18})(?: lines ([0-9]{1,9}))?\n((?:late [0-9]{1,18} [0-9]{1,18}\n)*)"
    r"(?:windows ([0-9]{1,9})\n((?:window [0-9]{1,18} [0-9]{1,18}\n)*))?\Z"
)


def lateness_text(before: Lateness, after: Lateness) -> str:
    """Return the file text for the packets and windows that were counted between `before` and `after`."""
    lines = _histogram_lines("late", before.packets, after.packets)
    text = "".join((f"bound {after.bound_ns} lines {len(lines)}\n", *lines))
    if after.windows is None:
        return text
    windows = _histogram_lines("window", before.windows or {}, after.windows)
    return text + "".join((f"windows {len(windows)}\n", *windows))


def _histogram_lines(word: str, before: Mapping[int, int], after: Mapping[int, int]) -> list[str]:
    increments = {late_ns: count - before.get(late_ns, 0) for late_ns, count in sorted(after.items())}
    return [f"{word} {late_ns} {count}\n" for late_ns, count in increments.items() if count]


def read_lateness(path: Path) -> Lateness:
    """Return the lateness in a file.

    Raises:
        EvidenceError: The file is missing, truncated, not a file of packet lateness, or has an impossible count.
    """
    match = _LATENESS_TEXT.match(reading.text(path))
    if match is None:
        raise EvidenceError("is not a file of packet lateness", where=str(path))
    bound, line_count, body, window_count, window_body = match.groups()
    packets = _histogram(path, line_count, body)
    if sum(packets.values()) >= _MAX_PACKETS:
        raise EvidenceError("contains an impossible number of packets", where=str(path))
    windows = None if window_count is None else _histogram(path, window_count, window_body)
    return Lateness(bound_ns=int(bound), packets=packets, windows=windows)


def _histogram(path: Path, line_count: str | None, body: str) -> dict[int, int]:
    lines = body.splitlines()
    if line_count is not None and int(line_count) != len(lines):
        raise EvidenceError(f"is truncated: it has {len(lines)} of {line_count} lines", where=str(path))
    return {int(late_ns): int(count) for _, late_ns, count in map(str.split, lines)}


def lateness_quantile_ns(histogram: Mapping[int, int], share: float) -> int | None:
    """Return the quantile `share` (0 to 1) of a histogram of lateness in ns, or None if the histogram is empty."""
    counts = sorted((late_ns, count) for late_ns, count in histogram.items() if count)
    cumulative = accumulate(count for _, count in counts)
    min_total = share * sum(count for _, count in counts)
    return next((late_ns for (late_ns, _), total in zip(counts, cumulative, strict=True) if total >= min_total), None)


def late_packet_count(lateness: Lateness) -> int:
    """Return the number of packets that were later than the bound."""
    return sum(count for late_ns, count in lateness.packets.items() if late_ns > lateness.bound_ns)


def measure_lateness(lateness: Lateness | None) -> Measured:
    """Return `LATENESS_COLUMNS`; `lateness` is None for real radios, or if the testbed cannot measure it."""
    if lateness is None:
        return Measured.all_missing(LATENESS_COLUMNS, "the radios are real, or their lateness is not measured")
    late_ns = {share: lateness_quantile_ns(lateness.packets, share) for share in (0.99, 1.0)}
    values = {
        "emulator_late_p99_s": None if late_ns[0.99] is None else late_ns[0.99] / 1e9,
        "emulator_late_max_s": None if late_ns[1.0] is None else late_ns[1.0] / 1e9,
        "emulator_too_late": late_packet_count(lateness),
    }
    return Measured.from_optional(values, "no packet was delivered")


def measure_window_lateness(lateness: Lateness | None) -> Measured:
    """Return `WINDOW_COLUMNS`, which have no values unless the testbed is a co-simulation."""
    if lateness is None or lateness.windows is None:
        return Measured.all_missing(WINDOW_COLUMNS, "the robots do not run on a co-simulation")
    late_ns = {share: lateness_quantile_ns(lateness.windows, share) for share in (0.99, 1.0)}
    values = {
        "cosim_late_p99_s": None if late_ns[0.99] is None else late_ns[0.99] / 1e9,
        "cosim_late_max_s": None if late_ns[1.0] is None else late_ns[1.0] / 1e9,
    }
    return Measured.from_optional(values, "no window ended")


def lateness_problem(lateness: Lateness) -> str | None:
    """Return a sentence if a packet or a window was later than the bound; otherwise None."""
    bound_ns, problem = lateness.bound_ns, ""
    packet_ns = lateness_quantile_ns(lateness.packets, 1.0)
    window_ns = lateness_quantile_ns(lateness.windows or {}, 1.0)
    if packet_ns is not None and packet_ns > bound_ns:
        late_text = format_count(late_packet_count(lateness), "packet")
        problem = f"{late_text} arrived too late, by up to {packet_ns / 1e6:.3g} ms"
    elif window_ns is not None and window_ns > bound_ns:
        windows = sum(count for late_ns, count in (lateness.windows or {}).items() if late_ns > bound_ns)
        windows_text = f"{format_count(windows, 'window')} of the co-simulation"
        problem = f"{windows_text} ended too late, by up to {window_ns / 1e6:.3g} ms"
    return f"{problem}; the bound is {bound_ns / 1e6:g} ms" if problem else None


AIR_DELAY_FILE: Final = laptop_files.MEDIUM

AIR_DELAY_COLUMNS: Final = columns(
    30,
    (
        "delay_s",
        "s",
        (
            "Mean one-way delay of the transfer's packets: the sum of the four components of the paper's eq. 2. "
            "Empty if the backend cannot measure it, for example with real radios."
        ),
        Figure("air delay", Kind.MEDIAN, rank=34),
    ),
    ("delay_processing_s", "s", "Part of delay_s: processing by the stations."),
    ("delay_transmission_s", "s", "Part of delay_s: transmission of the packet's bits at the rate of the link."),
    ("delay_propagation_s", "s", "Part of delay_s: propagation on the medium."),
    ("delay_queuing_s", "s", "Part of delay_s: waiting for earlier packets."),
    ("delay_packets", "count", "Number of delivered packets, over which delay_s is the mean."),
)

POLICY_COLUMNS: Final = columns(
    160,
    (
        "delay_policy_s",
        "s",
        (
            "Mean time that the sync policy of a co-simulation added to the delay of the transfer's packets; delay_s "
            "does not include it. Empty without a co-simulation."
        ),
        Figure("policy delay", Kind.MEDIAN, rank=34),
    ),
)

_COSIM_NAMES: Final = ("undivided_ns", "policy_ns")
_NAMES: Final = tuple(item.name for item in fields(DelayParts) if item.name not in _COSIM_NAMES)
# Times have at most 18 digits of nanoseconds, which are 31 years.
_NUMBER: Final = "([0-9]{1,18})"
_AIR_DELAY_TEXT: Final = re.compile(
    "".join(rf"{name} {_NUMBER}\n" for name in _NAMES)
    + rf"(?:{_COSIM_NAMES[0]} {_NUMBER}\n{_COSIM_NAMES[1]} {_NUMBER}\n)?\Z"
)


def read_air_delay(path: Path) -> DelayParts:
    """Return the delays in a file.

    Raises:
        EvidenceError: The file is missing or incomplete, or contains delays, but 0 packets.
    """
    match = _AIR_DELAY_TEXT.match(reading.text(path))
    if match is None:
        raise EvidenceError("is not a file of packet delays", where=str(path))
    numbers = {
        name: int(text)
        for name, text in zip((*_NAMES, *_COSIM_NAMES), match.groups(), strict=True)
        if text is not None
    }
    parts = DelayParts(**numbers)
    if not parts.packets and air_delay_ns(parts):
        raise EvidenceError("contains delays, but 0 packets", where=str(path))
    return parts


def air_delay_ns(parts: DelayParts) -> int:
    """Return the delay in ns, summed over all packets.

    It is the sum of the four components (the paper's eq. 2) and of the delay that the network did not divide into
    components.
    """
    components_ns = parts.processing_ns + parts.transmission_ns + parts.propagation_ns + parts.queuing_ns
    return components_ns + parts.undivided_ns


def air_delay_text(before: DelayParts, after: DelayParts) -> str:
    """Return the file text for the packets that were delivered between `before` and `after`."""
    names = _NAMES if after.policy_ns is None else (*_NAMES, *_COSIM_NAMES)
    return "".join(f"{name} {getattr(after, name) - (getattr(before, name) or 0)}\n" for name in names)


def measure_air_delay(parts: DelayParts | None) -> Measured:
    """Return `AIR_DELAY_COLUMNS`, means over the packets; `parts` is None if the testbed cannot measure the delay."""
    if parts is None:
        return Measured.all_missing(AIR_DELAY_COLUMNS, "the testbed cannot measure the delay on the air")
    scale = 1e9 * parts.packets
    is_divided = scale and not parts.undivided_ns
    values = {
        "delay_s": air_delay_ns(parts) / scale if scale else None,
        "delay_processing_s": parts.processing_ns / scale if is_divided else None,
        "delay_transmission_s": parts.transmission_ns / scale if is_divided else None,
        "delay_propagation_s": parts.propagation_ns / scale if is_divided else None,
        "delay_queuing_s": parts.queuing_ns / scale if is_divided else None,
        "delay_packets": parts.packets,
    }
    reason = "the network does not report the components" if scale else "no packet was delivered"
    return Measured.from_optional(values, reason)


def measure_policy_delay(parts: DelayParts | None) -> Measured:
    """Return `POLICY_COLUMNS`, a mean over the packets, which has no value unless the testbed is a co-simulation."""
    if parts is None or parts.policy_ns is None:
        return Measured.all_missing(POLICY_COLUMNS, "the robots do not run on a co-simulation")
    value = parts.policy_ns / 1e9 / parts.packets if parts.packets else None
    return Measured.from_optional({"delay_policy_s": value}, "no packet was delivered")
