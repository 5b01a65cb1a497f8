"""Lateness of packets during a repeat, noted by a testbed whose air is a model (`Oracle.lateness`).

The first line is the bound and how many lines follow, so that a file that was cut does not look whole: `bound
100000000 lines 12`, by earlier versions the bound alone. Then `late 896000 17` for each lateness: 17 packets were
late by at most 896,000 ns. All in integer nanoseconds, the lateness rounded up by an eighth at most.
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
            "99th percentile of how late packets were handed to their robots, against the emulator's own model, "
            "over the whole repeat; rounded up by an eighth at most. This and the next two are empty where the "
            "air is real."
        ),
    ),
    ("emulator_late_max_s", "s", "The latest of these packets."),
    (
        "emulator_too_late",
        "count",
        "How many of them were later than the site file's emulated.late_bound; the repeat is void above 0.",
    ),
)

# 18 digits of nanoseconds are 31 years.
_MOST_PACKETS: Final = 10**18
_FILE: Final = re.compile(r"bound ([0-9]{1,18})(?: lines ([0-9]{1,9}))?\n((?:late [0-9]{1,18} [0-9]{1,18}\n)*)\Z")


def text(before: Lateness, after: Lateness) -> str:
    """Return what came to `before` until `after`, as `read` reads it."""
    came = {late_ns: count - before.packets.get(late_ns, 0) for late_ns, count in sorted(after.packets.items())}
    lines = [f"late {late_ns} {count}\n" for late_ns, count in came.items() if count]
    return "".join((f"bound {after.bound_ns} lines {len(lines)}\n", *lines))


def read(path: Path) -> Lateness:
    """Return what stands in the file.

    Raises:
        EvidenceError: It is missing or not whole.
    """
    match = _FILE.match(reading.text(path))
    if match is None:
        raise EvidenceError("does not say how late packets were handed over", where=str(path))
    bound, announced, said = match.groups()
    lines = said.splitlines()
    if announced is not None and int(announced) != len(lines):
        raise EvidenceError(f"has {len(lines)} lines of {announced}: it was cut", where=str(path))
    packets = {int(late_ns): int(count) for _, late_ns, count in map(str.split, lines)}
    if sum(packets.values()) >= _MOST_PACKETS:
        raise EvidenceError("counts more packets than there can be", where=str(path))
    return Lateness(bound_ns=int(bound), packets=packets)


def quantile_ns(lateness: Lateness, share: float) -> int | None:
    """Return by how much at most `share` of the packets were late, None where there were no packets."""
    counts = sorted((late_ns, count) for late_ns, count in lateness.packets.items() if count)
    reached = accumulate(count for _, count in counts)
    wanted = share * sum(count for _, count in counts)
    return next((late_ns for (late_ns, _), so_far in zip(counts, reached, strict=True) if so_far >= wanted), None)


def too_late(lateness: Lateness) -> int:
    """Return how many packets were later than the bound."""
    return sum(count for late_ns, count in lateness.packets.items() if late_ns > lateness.bound_ns)


def measure(lateness: Lateness | None) -> Measured:
    """Return the columns; None where the air is real, or nobody can say."""
    if lateness is None:
        return Measured.nothing(COLUMNS, "the air is real")
    late_ns = {share: quantile_ns(lateness, share) for share in (0.99, 1.0)}
    values = {
        "emulator_late_p99_s": None if late_ns[0.99] is None else late_ns[0.99] / 1e9,
        "emulator_late_max_s": None if late_ns[1.0] is None else late_ns[1.0] / 1e9,
        "emulator_too_late": too_late(lateness),
    }
    return Measured.of(values, "no packet was handed over")


def problem(lateness: Lateness) -> str | None:
    """Return why the model was not kept, None if it was."""
    late_ns = quantile_ns(lateness, 1.0)
    if late_ns is None or late_ns <= lateness.bound_ns:
        return None
    late = f"{too_late(lateness)} packets were handed over late, by up to {late_ns / 1e6:.3g} ms"
    return f"{late}; the bound is {lateness.bound_ns / 1e6:g} ms"
