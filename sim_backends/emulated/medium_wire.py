"""Links and counters of the medium as messages."""

from dataclasses import dataclass
from typing import Any

from sim_backends.emulated.wire import Message
from sim_backends.radio.parameters import LinkCounters, LinkParameters, Pair


@dataclass(frozen=True)
class PortCounters:
    """What crossed the TUN device of one robot.

    Attributes:
        read: Packets that the robot sent.
        written: Packets that the robot was given.
        refused: Packets that arrived and that the robot's kernel did not take.
        unroutable: Packets to an address that no robot has.
        not_ipv4: Packets of another protocol than IPv4, which the medium does not carry.
    """

    read: int
    written: int
    refused: int
    unroutable: int
    not_ipv4: int


@dataclass(frozen=True)
class MediumStats:
    """What the medium did so far.

    Attributes:
        scheduling: `fifo 1`, or why the process runs without real-time priority.
        late_max_ns: By how much the latest packet was handed over after it had arrived, in ns.
        links: Counters per directed link.
        ports: Counters per robot.
    """

    scheduling: str
    late_max_ns: int
    links: dict[Pair, LinkCounters]
    ports: dict[str, PortCounters]


def pack_links(links: dict[Pair, LinkParameters]) -> list[Any]:
    """Return `links` as JSON rows."""
    return [[*pair, vars(parameters)] for pair, parameters in links.items()]


def unpack_links(rows: list[Any]) -> dict[Pair, LinkParameters]:
    """Return what `pack_links` packed."""
    return {(sender, receiver): LinkParameters(**values) for sender, receiver, values in rows}


def pack_stats(stats: MediumStats) -> Message:
    """Return `stats` as a message."""
    return {
        "scheduling": stats.scheduling,
        "late_max_ns": stats.late_max_ns,
        "links": [[*pair, vars(counters)] for pair, counters in stats.links.items()],
        "ports": {name: vars(counters) for name, counters in stats.ports.items()},
    }


def unpack_stats(message: Message) -> MediumStats:
    """Return what `pack_stats` packed."""
    return MediumStats(
        scheduling=message["scheduling"],
        late_max_ns=message["late_max_ns"],
        links={(sender, receiver): LinkCounters(**values) for sender, receiver, values in message["links"]},
        ports={name: PortCounters(**values) for name, values in message["ports"].items()},
    )
