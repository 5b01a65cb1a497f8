"""Parser of the output of `chronyc -n -c tracking` and `chronyc -n tracking`.

The fields with `-c` have the order of the report (chronyc(1), `tracking`): reference ID, name or address, stratum,
reference time, system time, last offset, RMS offset, frequency, residual frequency, skew, root delay, root
dispersion, update interval, leap status. The system time is the correction that is not applied yet: with `-c`, it is
negative if the clock is fast; without `-c`, the word `fast` or `slow` follows it. Its maximum error is root
dispersion + root delay / 2 (chronyc(1)).

If chronyd has no source, it prints 0 as the system time, which is not an offset.
"""

import re
from typing import Final

from fieldkit.measure.robot_state.clock_report import ClockReport
from fieldkit.measure.robot_state.snapshots import SourceOutput

NAME: Final = "chrony"
"""Name of the source in a snapshot, and of the program in reports."""

_FIELDS: Final = 14
"""Number of fields with `-c`."""
_LOCAL: Final = "7F7F0101"
"""Reference ID of a chronyd that serves its own clock (`local` in chrony.conf(5))."""
_SYNCHRONIZED: Final = frozenset(("Normal", "Insert second", "Delete second"))
_NUMBER: Final = re.compile(r"[+-]?[0-9]{1,10}\.[0-9]{1,12}", re.ASCII)
_REFERENCE: Final = re.compile(r"[0-9A-Fa-f]{1,8}", re.ASCII)
_ADDRESS: Final = re.compile(r"[A-Za-z0-9._:\[\]-]{1,60}", re.ASCII)
_LINE: Final = re.compile(
    r"^(Reference ID|System time|Root delay|Root dispersion|Leap status) *: (.{1,100})$", re.MULTILINE
)
_PLAIN_REFERENCE: Final = re.compile(r"([0-9A-Fa-f]{1,8})(?: \((.{0,60})\))?", re.ASCII)
_PLAIN_SECONDS: Final = re.compile(r"([0-9]{1,10}\.[0-9]{1,12}) seconds(?: (fast|slow) of NTP time)?", re.ASCII)
_NO_DAEMON: Final = "Cannot talk to daemon"


def parse(output: SourceOutput) -> ClockReport:
    """Return the report of chrony. If it has no offset, `problem` states the reason."""
    if _NO_DAEMON in output.text:
        return ClockReport(NAME, problem="chronyd does not run")
    if output.failure:
        return ClockReport(NAME, problem=f"chronyc {output.failure}")
    fields = _from_csv(output.text) or _from_lines(output.text)
    if fields is None:
        return ClockReport(NAME, problem="the output of chronyc cannot be read")
    reference_id, address, offset_s, delay_s, dispersion_s, leap = fields
    if leap not in _SYNCHRONIZED or not reference_id.strip("0"):
        return ClockReport(NAME, problem="chrony has no source")
    if reference_id == _LOCAL:
        return ClockReport(NAME, problem="chrony has no source and serves its own clock")
    return ClockReport(NAME, address or reference_id, offset_s, dispersion_s + delay_s / 2)


_Fields = tuple[str, str, float, float, float, str]
"""Reference ID, address, clock minus source in s, root delay in s, root dispersion in s, leap status."""


def _from_csv(text: str) -> _Fields | None:
    words = text.split("\n", 1)[0].split(",")
    if len(words) != _FIELDS or not _REFERENCE.fullmatch(words[0]):
        return None
    numbers = [words[index] for index in (4, 10, 11)]
    if not all(map(_NUMBER.fullmatch, numbers)):
        return None
    correction_s, delay_s, dispersion_s = map(float, numbers)
    if delay_s < 0 or dispersion_s < 0:
        return None
    return words[0].upper(), _address(words[1]), -correction_s + 0.0, delay_s, dispersion_s, words[13].strip()


def _from_lines(text: str) -> _Fields | None:
    lines = dict(_LINE.findall(text))
    reference = _PLAIN_REFERENCE.fullmatch(lines.get("Reference ID", ""))
    system, delay, dispersion = (
        _PLAIN_SECONDS.fullmatch(lines.get(name, "")) for name in ("System time", "Root delay", "Root dispersion")
    )
    if reference is None or system is None or system[2] is None or delay is None or dispersion is None:
        return None
    offset_s = float(system[1]) if system[2] == "fast" else 0.0 - float(system[1])
    address = _address(reference[2] or "")
    return (
        reference[1].upper(),
        address,
        offset_s,
        float(delay[1]),
        float(dispersion[1]),
        lines.get("Leap status", ""),
    )


def _address(text: str) -> str:
    return text if _ADDRESS.fullmatch(text) else ""
