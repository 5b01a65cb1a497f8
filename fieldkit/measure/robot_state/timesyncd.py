"""Parsers of the output of `timedatectl timesync-status` and `timedatectl show` (systemd 239 and later).

`Offset` is the time of the server minus the clock at the last poll; timesyncd then corrects the clock by this amount.
The current offset of the clock is therefore between `-Offset` and 0. Its maximum error is the sum of three values:
the maximum error of the server (`Root distance`), half of the round-trip time (`Delay`; RFC 5905, section 11.2), and
the correction itself.
"""

import re
from typing import Final

from fieldkit.measure.robot_state.clock_report import ClockReport
from fieldkit.measure.robot_state.snapshots import SourceOutput

NAME: Final = "timesyncd"
"""Name of the source in a snapshot."""
STATE_NAME: Final = "timedatectl"
"""Name of the source with the output of `timedatectl show`."""
PROGRAM: Final = "systemd-timesyncd"

_LINE: Final = re.compile(r"^ *([A-Z][a-zA-Z ]{1,20}): (.{1,200})$", re.MULTILINE)
_SERVER: Final = re.compile(r"([A-Za-z0-9._:%-]{1,60}|\(null\))(?: \(([A-Za-z0-9._:-]{1,60})\))?", re.ASCII)
_SPAN: Final = re.compile(
    r"[+-]?[0-9]{1,9}(?:\.[0-9]{1,9})?[a-z]{1,6}(?: [0-9]{1,9}(?:\.[0-9]{1,9})?[a-z]{1,6}){0,7}"
)
_PART: Final = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)([a-z]{1,6})")
# systemd.time(7): a month is 30.44 days, a year 365.25 days.
_SECONDS: Final = {
    "us": 1e-6,
    "ms": 1e-3,
    "s": 1.0,
    "min": 60.0,
    "h": 3600.0,
    "d": 86_400.0,
    "w": 604_800.0,
    "month": 2_629_800.0,
    "y": 31_557_600.0,
}
_SYNCHRONIZED: Final = re.compile(r"^NTPSynchronized=(yes|no)$", re.MULTILINE)
_NTP: Final = re.compile(r"^NTP=(yes|no)$", re.MULTILINE)


def parse(status: SourceOutput, state: SourceOutput | None) -> ClockReport | None:
    """Return the report of systemd-timesyncd, or None if it has no status and `timedatectl` reports it as disabled.

    Args:
        status: Output of `timedatectl timesync-status`.
        state: Output of `timedatectl show`; None if it is missing.
    """
    if status.failure and state is not None and not state.failure:
        ntp = _NTP.search(state.text)
        if ntp is None or ntp[1] == "no":  # timesyncd is disabled, and another program may set the clock
            return None
    if status.failure:
        return ClockReport(PROGRAM, problem=f"timedatectl {status.failure}")
    lines = dict(_LINE.findall(status.text))
    server = _SERVER.fullmatch(lines.get("Server", "").strip())
    if server is None:
        return ClockReport(PROGRAM, problem=f"{PROGRAM} has no server")
    offset_s, distance_s, delay_s = (
        span_s(lines.get(name, "").partition(" (")[0]) for name in ("Offset", "Root distance", "Delay")
    )
    if offset_s is None or distance_s is None or delay_s is None:
        return ClockReport(PROGRAM, problem=f"{PROGRAM} has no answer from its server")
    if state is not None and (synchronized := _SYNCHRONIZED.search(state.text)) and synchronized[1] == "no":
        return ClockReport(PROGRAM, problem=f"{PROGRAM} has not synchronized the clock")
    name = server[2] if server[1] == "(null)" else server[1]
    return ClockReport(PROGRAM, name or "", 0.0 - offset_s, distance_s + delay_s / 2 + abs(offset_s))


def span_s(text: str) -> float | None:
    """Return a time span such as `-1.087495s`, `2min 3s` or `0` in seconds; None if the text is not a time span."""
    text = text.strip()
    if text in {"0", "+0", "-0"}:
        return 0.0
    if not _SPAN.fullmatch(text):
        return None
    parts = _PART.findall(text)
    if any(unit not in _SECONDS for _, unit in parts):
        return None
    total_s = sum(float(number) * _SECONDS[unit] for number, unit in parts)
    return -total_s if text.startswith("-") else total_s


def is_synchronized(state: SourceOutput) -> bool | None:
    """Return True if any program synchronizes the kernel's clock; None if unknown.

    Args:
        state: Output of `timedatectl show`.
    """
    match = None if state.failure else _SYNCHRONIZED.search(state.text)
    return None if match is None else match[1] == "yes"
