"""The state of a host before and after an attempt: boot, clock, how jobs ended, counters of the network stack."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Measured, columns
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

SYSTEM: Final = columns(
    110,
    (
        "tcp_congestion_control",
        "text",
        (
            "Congestion control of the sender's TCP before the repeat (net.ipv4.tcp_congestion_control): cubic, bbr, "
            "reno. Empty for UDP."
        ),
    ),
)

_SHARED: Final = "other steps send UDP to the receiver, too, and its kernel counts all of it together"
_SECTION: Final = re.compile(r"^==> (?P<file>.+) <==$", re.MULTILINE)
_BOOT: Final = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
BOOT: Final = "boot"
CLOCK: Final = "clock"
JOBS: Final = "jobs"
_SNMP: Final = "/proc/net/snmp"
_CONGESTION: Final = "/proc/sys/net/ipv4/tcp_congestion_control"
_LONGEST_NAME: Final = 16
"""Bytes of a congestion control's name in Linux (TCP_CA_NAME_MAX)."""
_DEV: Final = "/proc/net/dev"
_KEPT: Final = (BOOT, CLOCK, "date", _SNMP, _DEV, "iw station dump", "end")
"""Sections whose values count: the same job script writes all that the host can provide, before and after."""


@dataclass(frozen=True)
class Counters:
    """Counters of /proc/net/snmp (RFC 1213 names; Linux adds RcvbufErrors); None where the file lacks one.

    Attributes:
        udp_buffer_errors: Datagrams that a full socket buffer refused, `Udp: RcvbufErrors`.
        reassembly_failures: Reassemblies given up, `Ip: ReasmFails`.
        udp_in_errors: Datagrams that did not reach their socket for any reason, `Udp: InErrors`.
        udp_send_errors: Datagrams that a full queue refused to send, `Udp: SndbufErrors`.
        udp_no_ports: Datagrams to a port without a listener, `Udp: NoPorts`.
    """

    udp_buffer_errors: int | None
    reassembly_failures: int | None
    udp_in_errors: int | None = None
    udp_send_errors: int | None = None
    udp_no_ports: int | None = None

    @property
    def udp_undelivered(self) -> int | None:
        """Datagrams that arrived whole and did not reach their socket; None if the kernel counts none."""
        known = [count for count in (self.udp_buffer_errors, self.udp_in_errors) if count is not None]
        return max(known, default=None)


@dataclass(frozen=True)
class HostState:
    """A host at one moment, beside its counters; None where the file does not tell.

    Attributes:
        boot: Which boot it was, by the kernel's identification of it.
        clock: Its clock.
        endings: How each job of the attempt had ended, by name; told after an attempt alone.
        sections: Names of its sections.
    """

    boot: str | None
    clock: Clock | None
    endings: Mapping[str, Ending] | None
    sections: frozenset[str] = frozenset()


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
    lines = {name: sections[name].split("\n") for name in (BOOT, CLOCK, JOBS) if name in sections}
    boot = next((match[0] for line in lines.get("boot", ()) if (match := _BOOT.fullmatch(line))), None)
    jobs = endings.parse(lines["jobs"]) if JOBS in lines else None
    return HostState(boot, clock.parse(lines.get(CLOCK, ())), jobs, frozenset(sections))


def lacking(before: HostState, after: HostState) -> Iterator[str]:
    """Yield the sections that a host wrote at one moment of an attempt and not at the other.

    A section that it cannot write is in neither. Files of versions that noted no boot have no jobs.
    """
    for name in _KEPT:
        if name in before.sections ^ after.sections:
            yield name
    if BOOT in before.sections and JOBS not in after.sections:
        yield JOBS
    for name, one, other in ((BOOT, before.boot, after.boot), (CLOCK, before.clock, after.clock)):
        if name in before.sections & after.sections and (one is None) != (other is None):
            yield name


def job_times_ns(path: Path) -> Mapping[str, tuple[int, int]]:
    """Return when each job on a host started and ended, in nanoseconds since 1970 UTC by its clock, to about 10 ms.

    Jobs whose end is unknown are left out, and all of them if the file does not say what the clock was.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    sections = _sections(reading.text(path))
    found = clock.parse(sections.get("clock", "").split("\n"))
    if found is None:
        return {}
    boot_ns = (found.lowest_ns + found.highest_ns) // 2
    times_s = endings.times_s(sections.get("jobs", "").split("\n"))
    return {
        name: (boot_ns + round(started_s * 1e9), boot_ns + round(ended_s * 1e9))
        for name, (started_s, ended_s) in times_s.items()
        if ended_s is not None
    }


def stations(path: Path) -> str:
    """Return what `iw station dump` printed, nothing where there was none; raises `EvidenceError` as `state`."""
    return _sections(reading.text(path)).get("iw station dump", "")


def congestion_control(path: Path) -> str | None:
    """Return the name of the host's TCP congestion control, or None if the file does not report it.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    name = _sections(reading.text(path)).get(_CONGESTION, "").strip()
    return name if len(name) <= _LONGEST_NAME and re.fullmatch(r"[a-z][a-z0-9_-]*", name) else None


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
        udp_in_errors=table.get(("Udp", "InErrors")),
        udp_send_errors=table.get(("Udp", "SndbufErrors")),
        udp_no_ports=table.get(("Udp", "NoPorts")),
    )


def received_bytes(path: Path, interface: str) -> int | None:
    """Return how many bytes a host's interface has received since it exists (/proc/net/dev); None if it is not there.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    table = _sections(reading.text(path)).get(_DEV, "")
    counter = re.search(rf"^\s*{re.escape(interface)}:\s*([0-9]{{1,18}})\s", table, re.MULTILINE)
    return int(counter[1]) if counter else None


def difference(before: Counters, after: Counters) -> Counters:
    """Return how the counters moved; None where one is missing or went back (the host restarted)."""
    return Counters(
        udp_buffer_errors=_moved(before.udp_buffer_errors, after.udp_buffer_errors),
        reassembly_failures=_moved(before.reassembly_failures, after.reassembly_failures),
        udp_in_errors=_moved(before.udp_in_errors, after.udp_in_errors),
        udp_send_errors=_moved(before.udp_send_errors, after.udp_send_errors),
        udp_no_ports=_moved(before.udp_no_ports, after.udp_no_ports),
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


def measure_system(congestion: str | None) -> Measured:
    """Return the columns of `SYSTEM`.

    Args:
        congestion: The sender's congestion control; None if it is unknown.
    """
    return Measured.of({"tcp_congestion_control": congestion}, "the sender's state does not report it")


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
