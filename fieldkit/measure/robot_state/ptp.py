"""Parser of the output of `pmc -u -b 0 'GET CURRENT_DATA_SET' 'GET TIME_STATUS_NP' 'GET PORT_DATA_SET'` of linuxptp.

Offsets and delays are in nanoseconds (pmc(8)). The error of the offset is at most the mean path delay; it has this
value if the whole delay is in one direction. With hardware time stamps, ptp4l reports the offset of the network
adapter's clock, with which phc2sys synchronizes the system clock. Only the first response of each kind is used,
because it is from the local clock.
"""

import re
from typing import Final

from fieldkit.measure.robot_state.clock_report import ClockReport
from fieldkit.measure.robot_state.snapshots import SourceOutput

NAME: Final = "ptp"
"""Name of the source in a snapshot."""
PROGRAM: Final = "ptp4l"

# Versions before 1.5 print "MANAGMENT".
_RESPONSE: Final = re.compile(
    r"^[ \t]*\S{1,40} seq [0-9]{1,9} RESPONSE MANAGE?MENT ([A-Z_]{1,40})[ \t]*$", re.MULTILINE
)
_LINE: Final = re.compile(r"^[ \t]*([A-Za-z_]{1,40}) +(\S{1,60})$", re.MULTILINE)
_NANOSECONDS: Final = re.compile(r"[+-]?[0-9]{1,19}(?:\.[0-9]{1,9})?", re.ASCII)
_CLOCK: Final = re.compile(r"[0-9a-f]{6}\.[0-9a-f]{4}\.[0-9a-f]{6}", re.ASCII)


def parse(output: SourceOutput) -> ClockReport:
    """Return the report of ptp4l. If it has no offset, `problem` states the reason."""
    if output.failure:
        return ClockReport(PROGRAM, problem=f"pmc {output.failure}")
    sections: dict[str, dict[str, str]] = {}
    parts = _RESPONSE.split(output.text)
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        sections.setdefault(name, dict(_LINE.findall(body)))
    status, current = sections.get("TIME_STATUS_NP"), sections.get("CURRENT_DATA_SET")
    port = sections.get("PORT_DATA_SET", {})
    if status is None or current is None:
        return ClockReport(PROGRAM, problem="ptp4l does not answer")
    state = port.get("portState", port.get("port_state", ""))
    if problem := _problem(state, has_master=status.get("gmPresent") == "true"):
        return ClockReport(PROGRAM, problem=problem)
    offset, delay, clock = (
        status.get("master_offset", ""),
        current.get("meanPathDelay", ""),
        status.get("gmIdentity", ""),
    )
    if not (_NANOSECONDS.fullmatch(offset) and _NANOSECONDS.fullmatch(delay) and _CLOCK.fullmatch(clock)):
        return ClockReport(PROGRAM, problem="the output of pmc cannot be read")
    return ClockReport(PROGRAM, clock, float(offset) / 1e9, abs(float(delay)) / 1e9)


def _problem(state: str, *, has_master: bool) -> str:
    """Return the reason why the clock is not synchronized, or an empty string if it is."""
    if state in {"MASTER", "GRAND_MASTER"}:
        return "ptp4l has no source and serves its own clock"
    if not has_master:
        return "ptp4l has no master"
    # Outputs without the state of the port are accepted.
    return "" if state in {"", "SLAVE"} else "ptp4l is not synchronized to its master"
