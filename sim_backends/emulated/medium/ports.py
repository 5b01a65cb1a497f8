"""Ports of the medium, and its statistics: what robots sent and were given, how late, and what delayed it."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass
from ipaddress import IPv4Interface
from typing import Final

from fieldkit.core.model import DelayParts, LinkSample, StationSample
from sim_backends.emulated.medium.framing import Routes
from sim_backends.emulated.process.ipc import Message
from sim_backends.radio.delay import Delay, parts
from sim_backends.radio.links import LinkCounters, Pair

_KEPT_BITS: Final = 4


@dataclass(frozen=True)
class PortCounters:
    """What crossed the device of one robot.

    Attributes:
        read: Packets that the robot sent.
        written: Packets that the robot was given.
        refused: Packets that arrived and that the robot's kernel did not take.
        unroutable: Packets to an address that no robot has, or of or to a robot that is off the air.
        not_ipv4: Packets of another protocol than IPv4, which a medium of bare IP packets does not carry.
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


def pack_links(sampled: Iterable[Mapping[str, LinkSample]]) -> Message:
    """Return samples of links, each by robot, as a message."""
    return {"links": [[name, astuple(sample)] for samples in sampled for name, sample in samples.items()]}


def unpack_links(message: Message) -> dict[str, list[LinkSample]]:
    """Return the samples of each robot that `pack_links` packed, in their order."""
    links: dict[str, list[LinkSample]] = {}
    for name, (utc_ns, stations, *radio) in message["links"]:
        known = tuple(StationSample(*station) for station in stations)
        links.setdefault(name, []).append(LinkSample(utc_ns, known, *radio))
    return links


def rounded_up(late_ns: int) -> int:
    """Return the least number above `late_ns` of which all but the first four bits are 0: at most 1/8 more."""
    shift = late_ns.bit_length() - _KEPT_BITS
    return late_ns + 1 if shift <= 0 else ((late_ns >> shift) + 1) << shift


class Port:
    """One robot's TUN or TAP device, or what carries its packets in place of one; counters; and where packets go.

    Args:
        name: The robot.
        address: Its address.
        fd: The device.
    """

    def __init__(self, name: str, address: IPv4Interface, fd: int) -> None:
        self.name = name
        self.address = address
        self.fd = fd
        self.read = 0
        self.refused = 0
        self.unroutable = 0
        self.not_ipv4 = 0
        # So many of the packets that are read next may have waited in the device since then.
        self.backlog = 0
        self.backlog_since_ns = 0
        # Of what was written, by the robot that sent it; what was not written is counted by `refused`.
        self.delays: defaultdict[str, Delay] = defaultdict(int)
        self.routes: Routes = {}

    def delay_parts(self) -> dict[str, DelayParts]:
        """Return what the packets written were delayed by, per robot that sent them."""
        return {source: parts(delay) for source, delay in self.delays.items()}

    @property
    def counters(self) -> PortCounters:
        """What crossed the device so far."""
        written = sum(delay.packets for delay in self.delay_parts().values())
        return PortCounters(self.read, written, self.refused, self.unroutable, self.not_ipv4)
