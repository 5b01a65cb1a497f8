"""The state of a host before and after an attempt: boot, clock, job terminations, counters of the network stack."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Measured, columns
from fieldkit.core.model import Role
from fieldkit.measure.evidence import clock, reading, terminations
from fieldkit.measure.evidence.clock import Clock
from fieldkit.measure.evidence.terminations import Termination

COLUMNS: Final = columns(
    80,
    (
        "receiver_udp_buffer_errors",
        "count",
        "Datagrams dropped during the repeat because the receiver's socket buffer was full (RcvbufErrors).",
    ),
    (
        "receiver_reassembly_failures",
        "count",
        "IP reassemblies that failed in the receiver's kernel during the repeat (ReasmFails).",
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

_SHARED_REASON: Final = "other steps also send UDP to the receiver, and its kernel has one counter for all datagrams"
_SECTION: Final = re.compile(r"^==> (?P<file>.+) <==$", re.MULTILINE)
_BOOT: Final = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
BOOT: Final = "boot"
CLOCK: Final = "clock"
JOBS: Final = "jobs"
"""Names of sections; see `before_file`."""
_SNMP: Final = "/proc/net/snmp"
_CONGESTION: Final = "/proc/sys/net/ipv4/tcp_congestion_control"
_MAX_NAME_BYTES: Final = 16
"""Limit of the length of the name of a congestion control in Linux (TCP_CA_NAME_MAX, which includes a NUL byte)."""
_DEV: Final = "/proc/net/dev"
_REQUIRED_SECTIONS: Final = (BOOT, CLOCK, "date", _SNMP, _DEV, "iw station dump", "end")
"""Sections that must be in both files of an attempt or in neither. The same script writes both files, and each file
contains the sections that the host supports.
"""


@dataclass(frozen=True)
class Counters:
    """Counters of /proc/net/snmp (names of RFC 1213; Linux adds RcvbufErrors, SndbufErrors); None if missing.

    Attributes:
        udp_buffer_errors: Datagrams dropped because of a full receive buffer, `Udp: RcvbufErrors`.
        reassembly_failures: Failed IP reassemblies, `Ip: ReasmFails`.
        udp_in_errors: Datagrams that could not be delivered for any reason except a port without a listener,
            `Udp: InErrors`. They include `udp_buffer_errors`.
        udp_send_errors: Datagrams that were not sent because of a full buffer, `Udp: SndbufErrors`.
        udp_no_ports: Datagrams to a port without a listener, `Udp: NoPorts`.
    """

    udp_buffer_errors: int | None
    reassembly_failures: int | None
    udp_in_errors: int | None = None
    udp_send_errors: int | None = None
    udp_no_ports: int | None = None

    @property
    def udp_undelivered(self) -> int | None:
        """Datagrams that arrived for a listener, but were not delivered to it; None if no counter is known.

        It is the larger of `udp_in_errors` and `udp_buffer_errors`.
        """
        counts = [count for count in (self.udp_buffer_errors, self.udp_in_errors) if count is not None]
        return max(counts, default=None)


@dataclass(frozen=True)
class HostState:
    """State of a host at one time, without its counters. An attribute is None if the file does not contain it.

    Attributes:
        boot: Boot ID of the kernel.
        clock: Bounds of the clock.
        terminations: Terminations of the attempt's jobs by name; only in the state after an attempt.
        sections: Names of the file's sections.
    """

    boot: str | None
    clock: Clock | None
    terminations: Mapping[str, Termination] | None
    sections: frozenset[str] = frozenset()


def before_file(role: Role) -> str:
    """Return the name of the file with a robot's state before an attempt.

    The file has sections. Each section has a line `==> NAME <==`, and the content of the file or the output of the
    command with this name.
    """
    return f"{role}-before.txt"


def after_file(role: Role) -> str:
    """Return the name of the file with a robot's state after an attempt."""
    return f"{role}-after.txt"


def read_state(path: Path) -> HostState:
    """Return the state in a host-state file, without counters.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    sections = _sections(reading.text(path))
    lines = {name: sections[name].split("\n") for name in (BOOT, CLOCK, JOBS) if name in sections}
    boot = next((match[0] for line in lines.get("boot", ()) if (match := _BOOT.fullmatch(line))), None)
    jobs = terminations.parse(lines["jobs"]) if JOBS in lines else None
    return HostState(boot, clock.parse(lines.get(CLOCK, ())), jobs, frozenset(sections))


def incomplete_sections(before: HostState, after: HostState) -> Iterator[str]:
    """Yield the names of incomplete sections.

    A section is incomplete if only one of the two states contains it, or contains a valid boot ID or clock in it. A
    section that the host does not support is in neither state. The section of jobs must be in the state after the
    attempt, except in files of fieldkit versions that did not record the boot ID.
    """
    for name in _REQUIRED_SECTIONS:
        if name in before.sections ^ after.sections:
            yield name
    if BOOT in before.sections and JOBS not in after.sections:
        yield JOBS
    for name, first, second in ((BOOT, before.boot, after.boot), (CLOCK, before.clock, after.clock)):
        if name in before.sections & after.sections and (first is None) != (second is None):
            yield name


def job_times_ns(path: Path) -> Mapping[str, tuple[int, int]]:
    """Return start and end of each job on a host, in nanoseconds since 1970 UTC by its clock.

    They are accurate to about 10 ms, or to 0.5 s if the file has the clock in whole seconds. Jobs whose end is
    unknown are omitted; the result is empty if the file does not contain the clock.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    sections = _sections(reading.text(path))
    bounds = clock.parse(sections.get("clock", "").split("\n"))
    if bounds is None:
        return {}
    boot_ns = (bounds.lowest_ns + bounds.highest_ns) // 2
    times_s = terminations.times_s(sections.get("jobs", "").split("\n"))
    return {
        name: (boot_ns + round(started_s * 1e9), boot_ns + round(ended_s * 1e9))
        for name, (started_s, ended_s) in times_s.items()
        if ended_s is not None
    }


def station_dump(path: Path) -> str:
    """Return the output of `iw station dump`, or an empty string if it is missing.

    Raises the same errors as `read_state`.
    """
    return _sections(reading.text(path)).get("iw station dump", "")


def congestion_control(path: Path) -> str | None:
    """Return the name of the host's TCP congestion control, or None if the file does not contain a valid name.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    name = _sections(reading.text(path)).get(_CONGESTION, "").strip()
    return name if len(name) <= _MAX_NAME_BYTES and re.fullmatch(r"[a-z][a-z0-9_-]*", name) else None


def read_counters(path: Path) -> Counters:
    """Return the counters of a host-state file.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    return parse_counters(reading.text(path))


def parse_counters(text: str) -> Counters:
    """Return the counters in the text of a host-state file; missing counters are None."""
    table = _parse_snmp(_sections(text).get(_SNMP, ""))
    return Counters(
        udp_buffer_errors=table.get(("Udp", "RcvbufErrors")),
        reassembly_failures=table.get(("Ip", "ReasmFails")),
        udp_in_errors=table.get(("Udp", "InErrors")),
        udp_send_errors=table.get(("Udp", "SndbufErrors")),
        udp_no_ports=table.get(("Udp", "NoPorts")),
    )


def received_bytes(path: Path, interface: str) -> int | None:
    """Return the number of bytes that an interface has received (/proc/net/dev), or None if it is not listed.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    table = _sections(reading.text(path)).get(_DEV, "")
    counter = re.search(rf"^\s*{re.escape(interface)}:\s*([0-9]{{1,18}})\s", table, re.MULTILINE)
    return int(counter[1]) if counter else None


def increments(before: Counters, after: Counters) -> Counters:
    """Return the increments of the counters; None for a counter that is missing or decreased, as after a reboot."""
    return Counters(
        udp_buffer_errors=_increment(before.udp_buffer_errors, after.udp_buffer_errors),
        reassembly_failures=_increment(before.reassembly_failures, after.reassembly_failures),
        udp_in_errors=_increment(before.udp_in_errors, after.udp_in_errors),
        udp_send_errors=_increment(before.udp_send_errors, after.udp_send_errors),
        udp_no_ports=_increment(before.udp_no_ports, after.udp_no_ports),
    )


def _increment(before: int | None, after: int | None) -> int | None:
    if before is None or after is None or after < before:
        return None
    return after - before


def _sections(text: str) -> dict[str, str]:
    parts = _SECTION.split(text)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def _parse_snmp(snmp: str) -> dict[tuple[str, str], int]:
    """Return the counters by group and name; each group has a line of names and a line of values."""
    names: dict[str, list[str]] = {}
    counters: dict[tuple[str, str], int] = {}
    for line in snmp.splitlines():
        group, _, text = line.partition(":")
        words = text.split()
        if group not in names:
            names[group] = words
            continue
        for name, value in zip(names[group], words, strict=False):
            if re.fullmatch(r"-?[0-9]{1,18}", value):
                counters[group, name] = int(value)
    return counters


def without_shared_counters(measured: Measured) -> Measured:
    """Return the columns of `measure` for a repeat in which other steps also send UDP to the receiver.

    A counter above 0 is removed, because it may include datagrams of other steps. A counter of 0 is valid for every
    step.
    """
    names = (column.name for column in COLUMNS)
    return measured.without({name: _SHARED_REASON for name in names if measured.values.get(name)})


def measure_system(congestion: str | None) -> Measured:
    """Return the columns of `SYSTEM`.

    Args:
        congestion: The sender's congestion control; None if unknown.
    """
    return Measured.from_optional({"tcp_congestion_control": congestion}, "the sender's state does not report it")


def measure(before: Counters | None, after: Counters | None) -> Measured:
    """Return the columns; `before` and `after` are None if the state is not available."""
    if before is None or after is None:
        return Measured.all_missing(COLUMNS, "the receiver's state is not available")
    counters = increments(before, after)
    values = {
        "receiver_udp_buffer_errors": counters.udp_buffer_errors,
        "receiver_reassembly_failures": counters.reassembly_failures,
    }
    return Measured.from_optional(values, "the receiver restarted, or does not count them")
