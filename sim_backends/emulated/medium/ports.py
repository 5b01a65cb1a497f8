"""Ports of the medium (the devices of the robots), with their counters, and the delays of flows."""

from collections import defaultdict
from ipaddress import IPv4Address, IPv4Interface
from typing import Final

from fieldkit.core.model import DelayParts
from sim_backends.emulated.medium.framing import Routes
from sim_backends.emulated.medium.medium_stats import PortCounters
from sim_backends.radio.core.links import PACKET, Delay, delay_parts

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
