"""Links and counters of the medium as messages."""

from dataclasses import dataclass

from fieldkit.core.model import DelayParts
from sim_backends.emulated.process.wire import Message
from sim_backends.radio.links import LinkCounters, Pair


@dataclass(frozen=True)
class PortCounters:
    """What crossed the TUN device of one robot.

    Attributes:
        read: Packets that the robot sent.
        written: Packets that the robot was given.
        refused: Packets that arrived and that the robot's kernel did not take.
        unroutable: Packets to an address that no robot has, or of or to a robot that is off the air.
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
        late: How many packets were so many ns late, as `lateness.rounded_up` has it: the time that they waited to be
            read, at most, and the time between their arrival by the model and their handing over.
        links: Counters per directed link.
        ports: Counters per robot.
        delays: What the packets written to a robot were delayed by, per pair of who sent them and that robot; the
            time by which the medium was late is processing.
    """

    scheduling: str
    late: dict[int, int]
    links: dict[Pair, LinkCounters]
    ports: dict[str, PortCounters]
    delays: dict[Pair, DelayParts]


def pack_stats(stats: MediumStats) -> Message:
    """Return `stats` as a message."""
    return {
        "scheduling": stats.scheduling,
        "late": [*stats.late.items()],
        "links": [[*pair, vars(counters)] for pair, counters in stats.links.items()],
        "ports": {name: vars(counters) for name, counters in stats.ports.items()},
        "delays": [[*pair, vars(parts)] for pair, parts in stats.delays.items()],
    }


def unpack_stats(message: Message) -> MediumStats:
    """Return what `pack_stats` packed."""
    return MediumStats(
        scheduling=message["scheduling"],
        late=dict(message["late"]),
        links={(sender, receiver): LinkCounters(**values) for sender, receiver, values in message["links"]},
        ports={name: PortCounters(**values) for name, values in message["ports"].items()},
        delays={(source, robot): DelayParts(**values) for source, robot, values in message["delays"]},
    )
