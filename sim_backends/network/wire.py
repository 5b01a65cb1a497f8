"""Protocols between transports and what is below them: IP packets, timers, and what becomes of a program's packets.

A transport holds what both ends know, yet an end learns nothing but by what it receives. It runs on whatever keeps
these protocols: on the radio, or in a test on a link whose losses are written down.
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
        source: Who sends it.
        destination: Who shall get it; None is everyone, as by multicast.
        transport: Name of the transport that it belongs to.
        size_bytes: Its size, the header of the internet protocol included.
        identity: What the random draws that decide over it are keyed by; what is sent again has another.
        body: What the transport put into it; the network below does not look at it.
    """

    source: str
    destination: str | None
    transport: str
    size_bytes: int
    identity: PacketIdentity
    body: Any


class Wire(Protocol):
    """What a transport stands on.

    Attributes:
        now_ns: Now, in nanoseconds of simulated time.
    """

    now_ns: int

    def transmit(self, packet: IpPacket) -> None:
        """Send an IP packet now; it arrives, later, by `Transport.receive`, or not."""
        ...

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """Call `call` on a host at `at_ns`, not before now, or once the host is on again if it is off then.

        A timer that is no longer wanted does nothing when it is called.
        """
        ...

    def deliver(self, packet_id: int) -> None:
        """Take it that a program's packet is whole at its destination now."""
        ...

    def drop(self, packet_id: int, reason: str) -> None:
        """Take it that a program's packet never arrives; one that was delivered stays so."""
        ...


class Transport(Protocol):
    """Carries packets of programs in IP packets."""

    def send(self, packet: Packet) -> None:
        """Carry a program's packet, which its source hands over now."""
        ...

    def receive(self, host: str, packet: IpPacket) -> None:
        """Take an IP packet of this transport that arrived, whole, at `host` now."""
        ...

    def lost(self, packet: IpPacket, reason: str) -> None:
        """Learn, for the account only, that an IP packet, or a part of it, will not arrive at its destination.

        No end of a real connection is told this, so it must change nothing that an end does.
        """
        ...
