"""UDP (RFC 768): a header of 8 bytes, without retransmission."""

from typing import Final

from sim_backends.network import ip
from sim_backends.network.packets import Packet
from sim_backends.network.wire import IpPacket, Wire

HEADER_BYTES: Final = 8


class Udp:
    """Carries each packet of a program in one datagram.

    Args:
        wire: The network below.
    """

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    def send(self, packet: Packet) -> None:
        """Implement `Transport.send`."""
        size_bytes = ip.HEADER_BYTES + HEADER_BYTES + packet.size_bytes
        self._wire.transmit(
            IpPacket(packet.source, packet.destination, "udp", size_bytes, packet.identity, packet.packet_id)
        )

    def receive(self, host: str, packet: IpPacket) -> None:  # noqa: ARG002 (see Transport)
        """Implement `Transport.receive`."""
        self._wire.deliver(packet.body)

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Implement `Transport.record_loss`."""
        self._wire.drop(packet.body, reason)
