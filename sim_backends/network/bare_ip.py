"""Transports of bare IP packets: each packet that a program sends is one IP packet, whose size includes its headers.

The programs are real, and the kernels of their hosts have already built the packets. A broadcast or multicast
enters the network as one packet per receiver, all with the same source, number and time; the radio sends them as one
frame.
"""

from dataclasses import dataclass, field
from typing import Final

from sim_backends.network.packets import Packet
from sim_backends.network.wire import IpPacket, Wire

UNICAST: Final = "ip"
"""Name of the transport of packets with one receiver."""
BROADCAST: Final = "ip-broadcast"
"""Name of the transport of broadcasts and multicasts."""


def broadcast_flow(source: str) -> str:
    """Return the flow from which the random draws of a source's broadcasts are derived."""
    return f"{source} > all"


class BareIp:
    """Carries packets with one receiver.

    Args:
        wire: The network below.
    """

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    def send(self, packet: Packet) -> None:
        """Implement `Transport.send`."""
        self._wire.transmit(
            IpPacket(packet.source, packet.destination, UNICAST, packet.size_bytes, packet.identity, packet.packet_id)
        )

    def receive(self, host: str, packet: IpPacket) -> None:  # noqa: ARG002 (see Transport)
        """Implement `Transport.receive`."""
        self._wire.deliver(packet.body)

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Implement `Transport.record_loss`."""
        self._wire.drop(packet.body, reason)


@dataclass(slots=True)
class _Group:
    """The packets of one broadcast.

    Attributes:
        packet_ids: ID of the packet to each receiver that has neither received nor missed the frame.
        miss_reasons: Reason for each receiver that missed the frame before the packet addressed to it was sent.
    """

    packet_ids: dict[str, int] = field(default_factory=dict)
    miss_reasons: dict[str, str] = field(default_factory=dict)


class BareBroadcast:
    """Carries broadcasts.

    When the first packet of a group is sent, one frame is transmitted that carries all packets of the group.

    Args:
        wire: The network below.
    """

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._last_groups: dict[str, tuple[int, _Group]] = {}

    def send(self, packet: Packet) -> None:
        """Implement `Transport.send`."""
        source, number = packet.source, packet.identity[1]
        last_number, group = self._last_groups.get(source, (None, None))
        if group is None or last_number != number:
            group = _Group()
            self._last_groups[source] = number, group
            identity = broadcast_flow(source), number
            self._wire.transmit(IpPacket(source, None, BROADCAST, packet.size_bytes, identity, group))
        if (reason := group.miss_reasons.pop(packet.destination, None)) is not None:
            self._wire.drop(packet.packet_id, reason)
        else:
            group.packet_ids[packet.destination] = packet.packet_id

    def receive(self, host: str, packet: IpPacket) -> None:
        """Implement `Transport.receive`."""
        group: _Group = packet.body
        if (packet_id := group.packet_ids.pop(host, None)) is not None:
            self._wire.deliver(packet_id)

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Implement `Transport.record_loss`; it is called only for packets with one receiver."""

    def record_miss(self, packet: IpPacket, host: str, reason: str) -> None:
        """Implement `CountsMisses.record_miss`."""
        group: _Group = packet.body
        packet_id = group.packet_ids.pop(host, None)
        if packet_id is None:
            group.miss_reasons[host] = reason
        else:
            self._wire.drop(packet_id, reason)
