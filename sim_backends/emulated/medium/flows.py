"""Delays of single flows: the packets from one address to one port of another, including fragments."""

from ipaddress import IPv4Address
from typing import Final

from fieldkit.core.model import DelayParts
from sim_backends.radio.delay import PACKET, Delay, parts

_MORE_FRAGMENTS: Final = 0x20
_OFFSET: Final = 0x1F

FlowKey = bytes
"""Protocol, source and destination address from the IPv4 header, and the destination port."""


class FlowDelays:
    """Delay sums of the flows that were requested, each since its first request.

    For other flows the cost is one look-up in `counted`, which is empty until the first request.

    Attributes:
        counted: Sum of the delays of each requested flow.
    """

    def __init__(self) -> None:
        self.counted: dict[FlowKey, Delay] = {}
        # Only the first fragment has a port: it maps the identification of its datagram to the flow.
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
        return parts(self.counted.setdefault(key, 0))

    def note_first_fragment(self, packet: bytes) -> None:
        """Remember the flow of a datagram when its first fragment is sent; other packets are ignored.

        Call it for each packet when it is sent, because the first fragment may be lost.
        """
        if packet[6] & _MORE_FRAGMENTS and not (packet[6] & _OFFSET or packet[7]):
            key, datagram = _key(packet), _datagram(packet)
            if key in self.counted:
                self._datagrams[datagram] = key
            else:
                # The identification is reused after 65,536 datagrams.
                self._datagrams.pop(datagram, None)

    def count(self, packet: bytes, delay: Delay, receiver: bytes) -> None:
        """Add the delay of a packet that crossed the radio, if its flow was requested.

        The packet is counted if `receiver`, an address, is its destination. Any other receiver forwards it: the delay
        of that hop is added, also if the packet is lost on a later hop.
        """
        is_later = packet[6] & _OFFSET or packet[7]
        key = self._datagrams.get(_datagram(packet)) if is_later else _key(packet)
        if key in self.counted:
            self.counted[key] += delay if packet[16:20] == receiver else delay - PACKET


def _key(packet: bytes) -> FlowKey:
    port_at = 4 * (packet[0] & 15) + 2
    return packet[9:10] + packet[12:20] + packet[port_at : port_at + 2]


def _datagram(packet: bytes) -> bytes:
    return packet[4:6] + packet[9:10] + packet[12:20]
