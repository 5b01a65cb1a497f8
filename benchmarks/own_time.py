"""A repeat's own time: its wall time less what the tools took on the robots, by phase."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from benchmarks.lifetimes import Lifetime

TOOLS: Final = {"rosbag": 1, "tcpdump": 2, "nc.traditional": 2, "ping": 1, "tar": 2}
"""What runs on the robots in one repeat, and how often."""


@dataclass(frozen=True)
class Repeat:
    """One repeat by one peer.

    Attributes:
        peer: `fieldkit` or `script`.
        protocol: Protocol under test.
        own_ms: Own time per phase, in ms.
        trips: Round trips over control links in sequence; 0 where nobody counts them.
    """

    peer: str
    protocol: str
    own_ms: dict[str, float]
    trips: int = 0

    @property
    def total_ms(self) -> float:
        """Own time of the repeat, in ms."""
        return sum(self.own_ms.values())


def own_time_ms(start_ns: int, phases: dict[str, int], end_ns: int, tools: Sequence[Lifetime]) -> dict[str, float]:
    """Return a repeat's wall time less what the tools took, in ms, split by phase.

    Args:
        start_ns: Start of the repeat.
        phases: When each phase began.
        end_ns: End of the repeat.
        tools: What ran on the robots meanwhile.
    """
    by_name = {tool.program: tool for tool in tools}
    record, ping = by_name["rosbag"], by_name["ping"]
    listen, send = listener_and_sender(tools)
    sent_ns = max(tool.end_ns for tool in tools if tool.program == "tar")
    own_ns = {
        "begin": phases["record"] - start_ns,
        "record": phases["start captures"] - phases["record"] - (record.end_ns - record.start_ns),
        "start captures": phases["transfer"] - phases["start captures"],
        "start listener, hold": send.start_ns - phases["transfer"],
        "end transfer": phases["drain captures"] - listen.end_ns,
        "drain captures": phases["ping"] - phases["drain captures"],
        "ping": phases["collect evidence"] - phases["ping"] - (ping.end_ns - ping.start_ns),
        "collect": sent_ns - phases["collect evidence"],
        "check, write": end_ns - sent_ns,
    }
    return {name: own / 1e6 for name, own in own_ns.items()}


def listener_and_sender(tools: Sequence[Lifetime]) -> tuple[Lifetime, Lifetime]:
    """Return the two nc of a repeat."""
    first, second = (tool for tool in tools if tool.program == "nc.traditional")
    return (first, second) if "-l" in first.argv else (second, first)


def command_lines(tools: Sequence[Lifetime]) -> frozenset[tuple[str, ...]]:
    """Return the command lines of the tools that are measured; tar only carries, so it is not among them."""
    return frozenset(tool.argv for tool in tools if tool.program != "tar")
