"""What packets were delayed by on the air, as a transfer notes it where its lab knows (`Testbed.delays`).

One line per number: `packets 215`, then the four parts summed over them, in integer nanoseconds.
"""

import re
from dataclasses import fields
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import DelayParts
from fieldkit.measure.evidence import reading

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
