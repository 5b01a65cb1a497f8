"""Begin and end of a fault by the laptop's clock, with the offsets of the robots' clocks: the laptop writes them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.evidence import reading
from fieldkit.measure.offsets import Offset

_SECONDS: Final = r"-?[0-9]{1,12}\.[0-9]{9}"
_FILE: Final = re.compile(
    r"began_utc_ns (?P<began>[0-9]{1,19})\nended_utc_ns (?P<ended>[0-9]{1,19}|unknown)\n"
    rf"(?P<ahead>(?:ahead_s [a-z0-9_]{{1,40}} {_SECONDS} {_SECONDS}\n)*)\Z"
)


def file(kind: FaultKind) -> str:
    """Return the file of the times of a fault."""
    return f"fault-{kind}-times.txt"


@dataclass(frozen=True)
class FaultTimes:
    """Times of a fault.

    Attributes:
        began_ns: When its cause began, nanoseconds since 1970 UTC by the laptop's clock.
        ended_ns: When its cause was over; None if that is unknown.
        ahead: By role how far the robot's clock is ahead of the laptop's.
    """

    began_ns: int
    ended_ns: int | None
    ahead: Mapping[Role, Offset]


def text(times: FaultTimes) -> str:
    """Return what `read` reads."""
    ended = "unknown" if times.ended_ns is None else str(times.ended_ns)
    lines = (f"ahead_s {role} {one.offset_s:.9f} {one.error_s:.9f}\n" for role, one in times.ahead.items())
    return f"began_utc_ns {times.began_ns}\nended_utc_ns {ended}\n{''.join(lines)}"


def read(path: Path) -> FaultTimes:
    """Return the times in a file.

    Raises:
        EvidenceError: It is missing or not whole.
    """
    try:
        return parse(reading.text(path))
    except EvidenceError as error:
        raise EvidenceError(error.what, where=str(path)) from error


def parse(content: str) -> FaultTimes:
    """Return the times in the content of a file.

    Raises:
        EvidenceError: It is not whole.
    """
    match = _FILE.match(content)
    if match is None:
        raise EvidenceError("does not say when the fault began and ended")
    words = (line.split() for line in match["ahead"].splitlines())
    ahead = {Role(role): Offset(float(offset_s), float(error_s)) for _, role, offset_s, error_s in words}
    return FaultTimes(int(match["began"]), None if match["ended"] == "unknown" else int(match["ended"]), ahead)
