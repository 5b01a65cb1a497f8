"""Ports of the medium (the devices of the robots), and their statistics: counts, lateness and delays of packets."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, field
from ipaddress import IPv4Address, IPv4Interface
from typing import Final

from fieldkit.core.model import DelayParts, LinkSample, StationSample
from sim_backends.emulated.medium.framing import Routes
from sim_backends.emulated.process.worker import Message
from sim_backends.radio.links import PACKET, Delay, LinkCounters, Pair, delay_parts

# Byte 6 of the IPv4 header: the flag MF, and the upper bits of the fragment offset; byte 7 has the lower bits.
_MORE_FRAGMENTS: Final = 0x20
_OFFSET: Final = 0x1F

FlowKey = bytes
"""Protocol, source and destination address from the IPv4 header, and the destination port."""


class FlowDelays:
    """Sums of the delays of each requested flow since the first request for it.

    `delays_by_flow` is empty until the first request. Until then the medium saves the calls of `note_first_fragment`
    and `count`.

    Attributes:
        delays_by_flow: Sum of the delays of each requested flow.
    """

    def __init__(self) -> None:
        self.delays_by_flow: dict[FlowKey, Delay] = {}
        # Flow of each fragmented datagram, by the datagram's identification: only the first fragment has the port.
        self._datagrams: dict[bytes, FlowKey] = {}

    def delay_parts(self, source: IPv4Address, destination: IPv4Address, protocol: int, port: int) -> DelayParts:
        """Return the delays of the packets of a flow, summed since the first call for this flow.

        Args:
            source: Source address.
            destination: Destination address.
            protocol: IP protocol number, of TCP or UDP.
            port: Destination port.
        """
        key = bytes((protocol,)) + source.packed + destination.packed + port.to_bytes(2, "big")
        return delay_parts(self.delays_by_flow.setdefault(key, 0))

    def note_first_fragment(self, packet: bytes) -> None:
        """Store the flow of a datagram when its first fragment is sent; other packets are ignored.

        Call it for each packet when it is sent, because the first fragment may be lost.
        """
        if packet[6] & _MORE_FRAGMENTS and not (packet[6] & _OFFSET or packet[7]):
            key, datagram = _key(packet), _datagram(packet)
            if key in self.delays_by_flow:
                self._datagrams[datagram] = key
            else:
                # The identification is reused after 65,536 datagrams.
                self._datagrams.pop(datagram, None)

    def count(self, packet: bytes, delay: Delay, receiver: bytes) -> None:
        """Add the delay of a packet that crossed the radio, if its flow was requested.

        The flow of a later fragment is known only if `note_first_fragment` stored it.
        The packet is counted if `receiver`, an address, is its destination. Any other receiver forwards it: the delay
        of that hop is added, even if the packet is lost on a later hop. A `Delay` contains the packet count;
        subtracting `PACKET` adds the delay without counting the packet.
        """
        is_later_fragment = packet[6] & _OFFSET or packet[7]
        key = self._datagrams.get(_datagram(packet)) if is_later_fragment else _key(packet)
        if key in self.delays_by_flow:
            self.delays_by_flow[key] += delay if packet[16:20] == receiver else delay - PACKET


def _key(packet: bytes) -> FlowKey:
    port_offset = 4 * (packet[0] & 15) + 2
    return packet[9:10] + packet[12:20] + packet[port_offset : port_offset + 2]


def _datagram(packet: bytes) -> bytes:
    return packet[4:6] + packet[9:10] + packet[12:20]


_KEPT_BITS: Final = 4
"""Number of significant bits of a lateness in a histogram."""


@dataclass(frozen=True)
class PortCounters:
    """Packet counters of the device of one robot.

    Attributes:
        sent_packets: Packets that the robot sent.
        delivered_packets: Packets delivered to the robot.
        refused_packets: Packets that arrived but that the robot's kernel refused.
        unroutable_packets: Packets to an address that no robot has, or from or to a robot that is off the air.
        other_packets: Packets that the medium does not carry: with IP framing those of other protocols than IPv4,
            with Ethernet framing those that are shorter than an Ethernet header.
    """

    sent_packets: int
    delivered_packets: int
    refused_packets: int
    unroutable_packets: int
    other_packets: int


@dataclass(frozen=True)
class MediumStats:
    """Statistics of the medium since its start.

    Attributes:
        scheduling: `fifo 1`, or the reason why the process has no real-time priority.
        packet_lateness_counts: Number of packets per lateness in ns, rounded by `round_up`. Lateness is the longest
            time that the packet can have waited to be read, plus the time from its arrival in the model until it was
            written.
        links: Counters per directed link.
        ports: Counters per robot.
        delays: Delays of the packets written to a robot, per pair of sender and receiver; lateness is counted as
            processing delay.
        window_lateness_counts: Number of windows of a co-simulation per lateness in ns, rounded by `round_up`. The
            lateness is the time from the end of the window until its packets were written. Empty for a medium
            without windows.
    """

    scheduling: str
    packet_lateness_counts: dict[int, int]
    links: dict[Pair, LinkCounters]
    ports: dict[str, PortCounters]
    delays: dict[Pair, DelayParts]
    window_lateness_counts: Mapping[int, int] = field(default_factory=dict)


def pack_stats(stats: MediumStats) -> Message:
    """Return the message for `stats`."""
    return {
        "scheduling": stats.scheduling,
        "packet_lateness_counts": [*stats.packet_lateness_counts.items()],
        "window_lateness_counts": [*stats.window_lateness_counts.items()],
        "links": [[*pair, vars(counters)] for pair, counters in stats.links.items()],
        "ports": {name: vars(counters) for name, counters in stats.ports.items()},
        "delays": [[*pair, vars(parts)] for pair, parts in stats.delays.items()],
    }


def unpack_stats(message: Message) -> MediumStats:
    """Return the statistics from a message of `pack_stats`."""
    return MediumStats(
        scheduling=message["scheduling"],
        packet_lateness_counts=dict(message["packet_lateness_counts"]),
        window_lateness_counts=dict(message["window_lateness_counts"]),
        links={(sender, receiver): LinkCounters(**values) for sender, receiver, values in message["links"]},
        ports={name: PortCounters(**values) for name, values in message["ports"].items()},
        delays={(source, robot): DelayParts(**values) for source, robot, values in message["delays"]},
    )


def pack_links(samples: Iterable[Mapping[str, LinkSample]]) -> Message:
    """Return the message for link samples; each item of `samples` maps robots to their samples at one time."""
    return {"links": [[name, astuple(sample)] for by_robot in samples for name, sample in by_robot.items()]}


def unpack_links(message: Message) -> dict[str, list[LinkSample]]:
    """Return the samples of each robot from a message of `pack_links`, in their order."""
    links: dict[str, list[LinkSample]] = {}
    for name, (utc_ns, stations, *radio) in message["links"]:
        station_samples = tuple(StationSample(*station) for station in stations)
        links.setdefault(name, []).append(LinkSample(utc_ns, station_samples, *radio))
    return links


def round_up(late_ns: int) -> int:
    """Return the smallest number above `late_ns` with at most 4 significant bits; from 8 ns on at most 1/8 larger."""
    shift = late_ns.bit_length() - _KEPT_BITS
    return late_ns + 1 if shift <= 0 else ((late_ns >> shift) + 1) << shift


class Port:
    """TUN or TAP device of one robot, or another packet descriptor; its counters and routes.

    Args:
        name: Name of the robot.
        address: Its address.
        fd: Descriptor of the device.

    Attributes:
        backlog: Number of packets in the device that may have waited since `backlog_since_ns`.
        backlog_since_ns: Earliest time at which these packets can have arrived.
        delays: Sum of the delays of the packets that were written to the device, by the robot that sent them.
        routes: Routes to the other robots (`framing.Routes`).

    The other attributes are those of `PortCounters`.
    """

    def __init__(self, name: str, address: IPv4Interface, fd: int) -> None:
        self.name = name
        self.address = address
        self.fd = fd
        self.sent_packets = 0
        self.refused_packets = 0
        self.unroutable_packets = 0
        self.other_packets = 0
        self.backlog = 0
        self.backlog_since_ns = 0
        self.delays: defaultdict[str, Delay] = defaultdict(int)
        self.routes: Routes = {}

    def delay_parts(self) -> dict[str, DelayParts]:
        """Return the delays of the written packets, per robot that sent them."""
        return {source: delay_parts(delay) for source, delay in self.delays.items()}

    @property
    def counters(self) -> PortCounters:
        """The current counters."""
        delivered_packets = sum(delay.packets for delay in self.delay_parts().values())
        return PortCounters(
            self.sent_packets, delivered_packets, self.refused_packets, self.unroutable_packets, self.other_packets
        )
