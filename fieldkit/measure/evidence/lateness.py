"""How late packets were handed over during a repeat, as a testbed whose air is a model notes it (`Testbed.lateness`).

The first line is the bound, `bound 100000000`; then `late 896000 17` for each lateness: 17 packets were late by at
most 896,000 ns. All in integer nanoseconds, the lateness rounded up by an eighth at most.
"""

import re
from itertools import accumulate
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Lateness
from fieldkit.measure.evidence import reading

# 18 digits of nanoseconds are 31 years.
_FILE: Final = re.compile(r"bound ([0-9]{1,18})\n((?:late [0-9]{1,18} [0-9]{1,18}\n)*)\Z")


def text(before: Lateness, after: Lateness) -> str:
    """Return what came to `before` until `after`, as `read` reads it."""
    came = {late_ns: count - before.packets.get(late_ns, 0) for late_ns, count in sorted(after.packets.items())}
    lines = [f"late {late_ns} {count}\n" for late_ns, count in came.items() if count]
    return "".join((f"bound {after.bound_ns}\n", *lines))


def read(path: Path) -> Lateness:
    """Return what stands in the file.

    Raises:
        EvidenceError: It is missing or not whole.
    """
    match = _FILE.match(reading.text(path))
    if match is None:
        raise EvidenceError("does not say how late packets were handed over", where=str(path))
    words = (line.split() for line in match[2].splitlines())
    return Lateness(bound_ns=int(match[1]), packets={int(late_ns): int(count) for _, late_ns, count in words})


def quantile_ns(lateness: Lateness, share: float) -> int | None:
    """Return by how much at most `share` of the packets were late, None where there were no packets."""
    counts = sorted((late_ns, count) for late_ns, count in lateness.packets.items() if count)
    reached = accumulate(count for _, count in counts)
    wanted = share * sum(count for _, count in counts)
    return next((late_ns for (late_ns, _), so_far in zip(counts, reached, strict=True) if so_far >= wanted), None)


def too_late(lateness: Lateness) -> int:
    """Return how many packets were later than the bound."""
    return sum(count for late_ns, count in lateness.packets.items() if late_ns > lateness.bound_ns)
