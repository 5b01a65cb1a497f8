"""The overhead of a repeat by phase: its wall time minus the times of rosbag, nc and ping on the robots."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from benchmarks.lifetimes import Lifetime

TOOLS: Final = {"rosbag": 1, "tcpdump": 2, "nc.traditional": 2, "ping": 1, "tar": 2}
"""Number of runs of each tool on the robots in one repeat."""


@dataclass(frozen=True)
class Repeat:
    """One repeat by one peer.

    Attributes:
        peer: `fieldkit` or `script`.
        protocol: Protocol under test.
        own_ms: Overhead per phase, in ms.
        trips: Sequential round trips over control links; 0 if they are not counted.
    """

    peer: str
    protocol: str
    own_ms: dict[str, float]
    trips: int = 0

    @property
    def total_ms(self) -> float:
        """Overhead of the repeat, in ms."""
        return sum(self.own_ms.values())


def overhead_ms(start_ns: int, phases: dict[str, int], end_ns: int, tools: Sequence[Lifetime]) -> dict[str, float]:
    """Return the wall time of a repeat minus the times of rosbag, nc and ping, in ms, by phase.

    The times in which captures start and end, and in which tar transports files, are part of the overhead.

    Args:
        start_ns: Start of the repeat.
        phases: Start of each phase.
        end_ns: End of the repeat.
        tools: Tools that ran on the robots during the repeat.
    """
    by_name = {tool.program: tool for tool in tools}
    record, ping = by_name["rosbag"], by_name["ping"]
    listen, send = listener_and_sender(tools)
    fetched_ns = max(tool.end_ns for tool in tools if tool.program == "tar")
    own_ns = {
        "begin": phases["record"] - start_ns,
        "record": phases["start captures"] - phases["record"] - (record.end_ns - record.start_ns),
        "start captures": phases["transfer"] - phases["start captures"],
        "start transfer": send.start_ns - phases["transfer"],
        "end transfer": phases["drain captures"] - listen.end_ns,
        "drain captures": phases["ping"] - phases["drain captures"],
        "ping": phases["collect evidence"] - phases["ping"] - (ping.end_ns - ping.start_ns),
        "collect": fetched_ns - phases["collect evidence"],
        "check, write": end_ns - fetched_ns,
    }
    return {name: own / 1e6 for name, own in own_ns.items()}


def listener_and_sender(tools: Sequence[Lifetime]) -> tuple[Lifetime, Lifetime]:
    """Return the listening and the sending nc of a repeat."""
    first, second = (tool for tool in tools if tool.program == "nc.traditional")
    return (first, second) if "-l" in first.argv else (second, first)


def command_lines(tools: Sequence[Lifetime]) -> frozenset[tuple[str, ...]]:
    """Return the command lines of the measured tools; tar only transports files and is not one of them."""
    return frozenset(tool.argv for tool in tools if tool.program != "tar")
