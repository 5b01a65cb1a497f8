"""The state of a host before and after an attempt: boot, clock, how jobs ended, counters of the network stack."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Measured, columns
from fieldkit.core.lazy import dataclass
from fieldkit.core.model import Role
from fieldkit.measure.evidence import clock, endings, reading
from fieldkit.measure.evidence.clock import Clock
from fieldkit.measure.evidence.endings import Ending

COLUMNS: Final = columns(
    80,
    (
        "receiver_udp_buffer_errors",
        "count",
        "Datagrams that the receiver's socket buffer refused during the repeat (RcvbufErrors).",
    ),
    (
        "receiver_reassembly_failures",
        "count",
        "Reassemblies that the receiver's kernel gave up during the repeat (ReasmFails).",
    ),
)

_SHARED: Final = "other steps send UDP to the receiver, too, and its kernel counts all of it together"
_SECTION: Final = re.compile(r"^==> (?P<file>.+) <==$", re.MULTILINE)
_BOOT: Final = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_SNMP: Final = "/proc/net/snmp"


@dataclass(frozen=True)
class Counters:
    """Counters of /proc/net/snmp (RFC 1213 names; Linux adds RcvbufErrors); None where the file lacks one.

    Attributes:
        udp_buffer_errors: Datagrams that a full socket buffer refused, `Udp: RcvbufErrors`.
        reassembly_failures: Reassemblies given up, `Ip: ReasmFails`.
    """

    udp_buffer_errors: int | None
    reassembly_failures: int | None


@dataclass(frozen=True)
class HostState:
    """A host at one moment, beside its counters; None where the file does not tell.

    Attributes:
        boot: Which boot it was, by the kernel's identification of it.
        clock: Its clock.
        endings: How each job of the attempt had ended, by name; told after an attempt alone.
    """

    boot: str | None
    clock: Clock | None
    endings: Mapping[str, Ending] | None


def before(role: Role) -> str:
    """Return the file of a robot's state before an attempt: sections, each a line `==> FILE <==` and its text."""
    return f"{role}-before.txt"


def after(role: Role) -> str:
    """Return the file of its state after it."""
    return f"{role}-after.txt"


def state(path: Path) -> HostState:
    """Return what a host-state file says beside counters.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    sections = _sections(reading.text(path))
    lines = {name: sections[name].split("\n") for name in ("boot", "clock", "jobs") if name in sections}
    boot = next((match[0] for line in lines.get("boot", ()) if (match := _BOOT.fullmatch(line))), None)
    return HostState(
        boot, clock.parse(lines.get("clock", ())), endings.parse(lines["jobs"]) if "jobs" in lines else None
    )


def stations(path: Path) -> str:
    """Return what `iw station dump` printed, nothing where there was none; raises `EvidenceError` as `state`."""
    return _sections(reading.text(path)).get("iw station dump", "")


def read(path: Path) -> Counters:
    """Return the counters of a host-state file.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    return parse(reading.text(path))


def parse(text: str) -> Counters:
    """Return the counters in the text of a host state; text without them gives None."""
    table = _table(_sections(text).get(_SNMP, ""))
    return Counters(
        udp_buffer_errors=table.get(("Udp", "RcvbufErrors")),
        reassembly_failures=table.get(("Ip", "ReasmFails")),
    )


def difference(before: Counters, after: Counters) -> Counters:
    """Return how the counters moved; None where one is missing or went back (the host restarted)."""
    return Counters(
        udp_buffer_errors=_moved(before.udp_buffer_errors, after.udp_buffer_errors),
        reassembly_failures=_moved(before.reassembly_failures, after.reassembly_failures),
    )


def _moved(before: int | None, after: int | None) -> int | None:
    if before is None or after is None or after < before:
        return None
    return after - before


def _sections(text: str) -> dict[str, str]:
    parts = _SECTION.split(text)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def _table(snmp: str) -> dict[tuple[str, str], int]:
    """Return the counters by group and name; each group is a line of names and one of values."""
    names: dict[str, list[str]] = {}
    counters: dict[tuple[str, str], int] = {}
    for line in snmp.splitlines():
        group, _, rest = line.partition(":")
        words = rest.split()
        if group not in names:
            names[group] = words
            continue
        for name, value in zip(names[group], words, strict=False):
            if re.fullmatch(r"-?[0-9]{1,18}", value):
                counters[group, name] = int(value)
    return counters


def shared(found: Measured) -> Measured:
    """Return the columns of `measure` where others send to the receiver, too: of nothing each has nothing."""
    names = (column.name for column in COLUMNS)
    return found.without({name: _SHARED for name in names if found.values.get(name)})


def measure(before: Counters | None, after: Counters | None) -> Measured:
    """Return the columns; None where a state is not at hand."""
    if before is None or after is None:
        return Measured.nothing(COLUMNS, "the receiver's state is not at hand")
    moved = difference(before, after)
    values = {
        "receiver_udp_buffer_errors": moved.udp_buffer_errors,
        "receiver_reassembly_failures": moved.reassembly_failures,
    }
    return Measured.of(values, "the receiver restarted, or does not count them")
