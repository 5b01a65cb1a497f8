"""Protocols between transports and the network below: IP packets, timers, and results of the programs' packets.

One transport object holds the state of both ends of a connection, but an end uses only information that it has
received. A transport runs on any implementation of `Wire`: on the radio, or in a test on a link with fixed losses.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from sim_backends.network.packets import Packet
from sim_backends.radio.random_streams import PacketIdentity


@dataclass(frozen=True, slots=True)
class IpPacket:
    """A packet of the internet protocol, before any fragmentation.

    Attributes:
        source: Name of the sender.
        destination: Name of the receiver; None for all stations (multicast).
        transport: Name of the transport to which it belongs.
        size_bytes: Its size with the IP header.
        identity: Key of its random draws; a retransmission has a different one.
        body: Content for the transport; the network below does not inspect it.
    """

    source: str
    destination: str | None
    transport: str
    size_bytes: int
    identity: PacketIdentity
    body: Any


class Wire(Protocol):
    """The network below a transport.

    Attributes:
        now_ns: Current simulated time.
    """

    now_ns: int

    def transmit(self, packet: IpPacket) -> None:
        """Send an IP packet now; if it arrives, `Transport.receive` is called later."""
        ...

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """Call `call` on a host at `at_ns`, which is not in the past; if the host is off then, when it is on again.

        Calls cannot be cancelled; a function whose timer was stopped must do nothing.
        """
        ...

    def deliver(self, packet_id: int) -> None:
        """Report that a program's packet is complete at its destination now."""
        ...

    def drop(self, packet_id: int, reason: str) -> None:
        """Report that a program's packet will never arrive; this is ignored if it was delivered."""
        ...


class Transport(Protocol):
    """A transport that carries packets of programs in IP packets."""

    def send(self, packet: Packet) -> None:
        """Send a program's packet; its source calls this at the time of sending."""
        ...

    def receive(self, host: str, packet: IpPacket) -> None:
        """Process an IP packet of this transport that has arrived, complete, at `host` now."""
        ...

    def lost(self, packet: IpPacket, reason: str) -> None:
        """Record, for statistics only, that an IP packet or a fragment of it will not arrive at its destination.

        The ends of a real connection do not have this information, so it must not change their behaviour.
        """
        ...
