"""Delays of single flows: of the packets from one address to one port of another, fragments too."""

from ipaddress import IPv4Address
from typing import Final

from fieldkit.core.model import DelayParts
from sim_backends.radio.delay import PACKET, Delay, parts

_MORE_FRAGMENTS: Final = 0x20
_OFFSET: Final = 0x1F

FlowKey = bytes
"""Protocol, source and destination address of an IPv4 header, and the destination port behind it."""


class FlowDelays:
    """Sums over the packets of each flow that somebody has asked for, from when that was first.

    Others cost a look at `counted`, which is empty as long as nobody has asked.

    Attributes:
        counted: What the packets of each flow were delayed by.
    """

    def __init__(self) -> None:
        self.counted: dict[FlowKey, Delay] = {}
        # Later fragments have no port: whose they are tells the first one, by the identification in front of its key.
        self._datagrams: dict[bytes, FlowKey] = {}

    def told(self, source: IPv4Address, destination: IPv4Address, protocol: int, port: int) -> DelayParts:
        """Return what the packets of a flow were delayed by since this was asked first.

        Args:
            source: From where.
            destination: To where.
            protocol: IP protocol number, of TCP or UDP.
            port: To which port.
        """
        key = bytes((protocol,)) + source.packed + destination.packed + port.to_bytes(2, "big")
        return parts(self.counted.setdefault(key, 0))

    def see_leave(self, packet: bytes) -> None:
        """Take note of whose fragments those behind a first one are; to be called with each as it is sent.

        The first one may never arrive.
        """
        if packet[6] & _MORE_FRAGMENTS and not (packet[6] & _OFFSET or packet[7]):
            key, datagram = _key(packet), _datagram(packet)
            if key in self.counted:
                self._datagrams[datagram] = key
            else:
                # An identification comes again after 65,536 datagrams.
                self._datagrams.pop(datagram, None)

    def count(self, packet: bytes, delay: Delay, receiver: bytes) -> None:
        """Count a packet that crossed the air, where it is of a flow that somebody has asked for.

        It counts as one packet where `receiver`, an address, is its destination. Who is not will forward it: its time
        on that hop counts, also if it is lost on a later one.
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
