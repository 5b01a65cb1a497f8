"""Start and end of a fault by the laptop's clock, and the offsets of the robots' clocks, in a file of the laptop."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
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
    """Return the name of the file with the times of a fault."""
    return laptop_files.fault_times_file(kind)


@dataclass(frozen=True)
class FaultTimes:
    """Times of a fault.

    Attributes:
        began_ns: Start of its cause, nanoseconds since 1970 UTC by the laptop's clock.
        ended_ns: End of its cause; None if unknown.
        ahead: Offset of each robot's clock from the laptop's, by role.
    """

    began_ns: int
    ended_ns: int | None
    ahead: Mapping[Role, Offset]


def text(times: FaultTimes) -> str:
    """Return the content of a file that `read` reads."""
    ended = "unknown" if times.ended_ns is None else str(times.ended_ns)
    lines = (f"ahead_s {role} {offset.offset_s:.9f} {offset.error_s:.9f}\n" for role, offset in times.ahead.items())
    return f"began_utc_ns {times.began_ns}\nended_utc_ns {ended}\n{''.join(lines)}"


def read(path: Path) -> FaultTimes:
    """Return the times in a file.

    Raises:
        EvidenceError: The file is missing or incomplete.
    """
    try:
        return parse(reading.text(path))
    except EvidenceError as error:
        raise EvidenceError(error.what, where=str(path)) from error


def parse(content: str) -> FaultTimes:
    """Return the times in the content of a file.

    Raises:
        EvidenceError: The content is incomplete.
    """
    match = _FILE.match(content)
    if match is None:
        raise EvidenceError("does not contain the start and end of the fault")
    words = (line.split() for line in match["ahead"].splitlines())
    ahead = {Role(role): Offset(float(offset_s), float(error_s)) for _, role, offset_s, error_s in words}
    return FaultTimes(int(match["began"]), None if match["ended"] == "unknown" else int(match["ended"]), ahead)
