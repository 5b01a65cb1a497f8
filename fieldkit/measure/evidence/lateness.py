"""Lateness of an emulator's packet deliveries during a repeat, compared with its radio model (`Oracle.lateness`).

The first line of the file has the bound and the number of the following lines, so that truncation can be detected:
`bound 100000000 lines 12`; earlier versions wrote only the bound. Each following line, as `late 896000 17`, means
that 17 packets were late by at most 896,000 ns. All times are integer nanoseconds; a lateness is rounded up by at
most an eighth.
"""

import re
from itertools import accumulate
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.columns import Measured, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Lateness
from fieldkit.measure.evidence import reading

FILE: Final = laptop_files.LATENESS

COLUMNS: Final = columns(
    50,
    (
        "emulator_late_p99_s",
        "s",
        (
            "99th percentile of the lateness with which packets were delivered to the robots, compared with the "
            "emulator's radio model, over the whole repeat; rounded up by at most an eighth. This and the next two "
            "columns are empty for real radios."
        ),
    ),
    ("emulator_late_max_s", "s", "Largest lateness of these packets."),
    (
        "emulator_too_late",
        "count",
        "Packets that were later than the site file's emulated.late_bound; above 0 the repeat is void.",
    ),
)

# 18 digits of nanoseconds are 31 years.
_MAX_PACKETS: Final = 10**18
_FILE: Final = re.compile(r"bound ([0-9]{1,18})(?: lines ([0-9]{1,9}))?\n((?:late [0-9]{1,18} [0-9]{1,18}\n)*)\Z")


def text(before: Lateness, after: Lateness) -> str:
    """Return the file text for the packets that were counted between `before` and `after`."""
    added = {late_ns: count - before.packets.get(late_ns, 0) for late_ns, count in sorted(after.packets.items())}
    lines = [f"late {late_ns} {count}\n" for late_ns, count in added.items() if count]
    return "".join((f"bound {after.bound_ns} lines {len(lines)}\n", *lines))


def read(path: Path) -> Lateness:
    """Return the lateness in a file.

    Raises:
        EvidenceError: The file is missing, truncated, or has other contents.
    """
    match = _FILE.match(reading.text(path))
    if match is None:
        raise EvidenceError("is not a lateness of packets", where=str(path))
    bound, line_count, body = match.groups()
    lines = body.splitlines()
    if line_count is not None and int(line_count) != len(lines):
        raise EvidenceError(f"has {len(lines)} lines of {line_count}: truncated", where=str(path))
    packets = {int(late_ns): int(count) for _, late_ns, count in map(str.split, lines)}
    if sum(packets.values()) >= _MAX_PACKETS:
        raise EvidenceError("contains an impossible number of packets", where=str(path))
    return Lateness(bound_ns=int(bound), packets=packets)


def quantile_ns(lateness: Lateness, share: float) -> int | None:
    """Return the quantile of the lateness at `share` (0 to 1) in ns; None if there are no packets."""
    counts = sorted((late_ns, count) for late_ns, count in lateness.packets.items() if count)
    cumulative = accumulate(count for _, count in counts)
    wanted = share * sum(count for _, count in counts)
    return next((late_ns for (late_ns, _), total in zip(counts, cumulative, strict=True) if total >= wanted), None)


def too_late(lateness: Lateness) -> int:
    """Return the number of packets that were later than the bound."""
    return sum(count for late_ns, count in lateness.packets.items() if late_ns > lateness.bound_ns)


def measure(lateness: Lateness | None) -> Measured:
    """Return the columns; `lateness` is None for real radios, or if the testbed cannot measure it."""
    if lateness is None:
        return Measured.all_missing(COLUMNS, "the radios are real")
    late_ns = {share: quantile_ns(lateness, share) for share in (0.99, 1.0)}
    values = {
        "emulator_late_p99_s": None if late_ns[0.99] is None else late_ns[0.99] / 1e9,
        "emulator_late_max_s": None if late_ns[1.0] is None else late_ns[1.0] / 1e9,
        "emulator_too_late": too_late(lateness),
    }
    return Measured.from_optional(values, "no packet was delivered")


def problem(lateness: Lateness) -> str | None:
    """Return why the emulation did not follow its model, or None if it did."""
    late_ns = quantile_ns(lateness, 1.0)
    if late_ns is None or late_ns <= lateness.bound_ns:
        return None
    late = f"{too_late(lateness)} packets were delivered too late, by up to {late_ns / 1e6:.3g} ms"
    return f"{late}; the bound is {lateness.bound_ns / 1e6:g} ms"
