"""Counters of a capture that tcpdump prints to standard error."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.model import Role
from fieldkit.measure.evidence import reading

# The line can start with progress output and `^C`; tcpdump uses the singular for one packet.
_COUNT: Final = re.compile(
    r"(?P<count>[0-9]{1,18}) packets? (?P<what>captured|received by filter|dropped by kernel|dropped by interface)$",
    re.MULTILINE,
)
_LISTENING: Final = re.compile(r"^tcpdump: listening on ", re.MULTILINE)


def capture_file(role: Role) -> str:
    """Return the name of the file with a robot's capture."""
    return f"{role}.pcap"


def monitor_file(role: Role) -> str:
    """Return the name of the file with a robot's capture on its monitor interface."""
    return f"{role}-monitor.pcap"


def capture_log_file(capture: str) -> str:
    """Return the name of the log that belongs to a capture's file name, with or without the name of a step."""
    return f"{capture.removesuffix('.pcap')}-capture.log"


@dataclass(frozen=True)
class CaptureLog:
    """Counters that tcpdump printed for a capture. They are None if tcpdump was killed before it printed them.

    Attributes:
        listening: True if tcpdump printed that it is listening; earlier packets are not captured.
        captured: Packets that were written to the file.
        received_by_filter: Packets that the kernel passed to libpcap; each packet is counted twice on a loopback
            interface. The count is larger than `captured` if other packets arrived between the opening of the socket
            and the installation of the filter. libpcap discards these packets (pcap-linux.c,
            `blocks_to_filter_in_userland`). At 5,000 other packets per second, 2 of 10 captures had one such packet.
        dropped_by_kernel: Packets that matched the filter while the capture buffer was full.
        dropped_by_interface: Packets that the interface or its driver dropped.
    """

    listening: bool
    captured: int | None
    received_by_filter: int | None
    dropped_by_kernel: int | None
    dropped_by_interface: int | None


def read(path: Path) -> CaptureLog:
    """Return the counters in a capture's log.

    Raises:
        EvidenceError: The log is missing or cannot be read.
    """
    return parse(reading.text(path))


def parse(text: str) -> CaptureLog:
    """Return the counters in the text of a log; they are None if the text does not contain them."""
    counts = {match["what"]: int(match["count"]) for match in _COUNT.finditer(text)}
    captured = counts.get("captured")
    return CaptureLog(
        listening=_LISTENING.search(text) is not None,
        captured=captured,
        received_by_filter=counts.get("received by filter"),
        dropped_by_kernel=counts.get("dropped by kernel"),
        # tcpdump omits this line, and only this one, if the count is 0.
        dropped_by_interface=counts.get("dropped by interface", None if captured is None else 0),
    )
