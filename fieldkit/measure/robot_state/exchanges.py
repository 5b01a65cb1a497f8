"""Exchanges of time stamps with each robot at the start of an attempt, over the control connection.

A request creates the attempt's folder on the robot. The laptop records its clock before this request and after the
response. Between these times, the robot reads its clock; `ROLE-before.txt` contains its readings.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.columns import Measured, Value
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import host, reading
from fieldkit.measure.evidence.clock import Clock
from fieldkit.measure.robot_clock import Offset

FILE: Final = laptop_files.EXCHANGES

WRONG_S: Final = 0.1
"""A clock with a larger offset is wrong. Such an offset is far above the errors of NTP, and visible in time stamps of
topics."""

_LINE: Final = re.compile(rf"({Role.PATTERN}) ([0-9]{{1,19}}) ([0-9]{{1,19}})", re.ASCII)

Exchanges = Mapping[Role, tuple[int, int]]
"""Laptop's clock before the request and after the response, in nanoseconds since 1970 UTC, by role."""


def text(exchanges: Exchanges) -> str:
    """Return the text of the file with the exchanges."""
    return "".join(f"{role} {request_ns} {response_ns}\n" for role, (request_ns, response_ns) in exchanges.items())


def read(path: Path) -> Exchanges:
    """Return the exchanges in a file; other lines are ignored.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    matches = filter(None, map(_LINE.fullmatch, reading.text(path).split("\n")))
    return {Role(match[1]): (int(match[2]), int(match[3])) for match in matches}


def offset(request_ns: int, response_ns: int, clock: Clock) -> Offset | None:
    """Return the offset of a robot's clock from the laptop's; None if either clock was set during the exchange."""
    lowest_ns, highest_ns = clock.last_ns - response_ns, clock.first_ns - request_ns
    if lowest_ns > highest_ns:
        return None
    return Offset((lowest_ns + highest_ns) / 2e9, (highest_ns - lowest_ns) / 2e9)


def laptop_offset(evidence: AttemptEvidence, role: Role) -> Offset | None:
    """Return the offset of a robot's clock from the laptop's at the start of an attempt; None if unknown."""
    times_ns = (evidence.read_or_none(read, FILE) or {}).get(role)
    state = evidence.read_or_none(host.read_state, host.before_file(role))
    if times_ns is None or state is None or state.clock is None:
        return None
    return offset(*times_ns, state.clock)


def is_wrong(clock_offset: Offset) -> bool:
    """Return True if an offset is certainly above `WRONG_S`, even with its maximum error."""
    return abs(clock_offset.offset_s) - clock_offset.error_s > WRONG_S


def measure(role: Role, clock_offset: Offset | None) -> Measured:
    """Return the columns of one robot's clock offset."""
    values: dict[str, Value | None] = {
        f"{role}_laptop_offset_s": None if clock_offset is None else clock_offset.offset_s,
        f"{role}_laptop_offset_error_s": None if clock_offset is None else clock_offset.error_s,
    }
    return Measured.from_optional(values, "the robot's clock was not read, or was set during the reading")
