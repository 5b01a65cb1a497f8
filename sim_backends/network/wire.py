"""Protocols between transports and the network below: IP packets, timers, and results of the programs' packets.

One transport object contains the state of both ends of a connection, but an end uses only information that it has
received. A transport runs on any implementation of `Wire`: on the radio, or in a test on a link with fixed losses.
Scheduled calls of a wire cannot be cancelled; `WireTimer` can be rescheduled and stopped.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

from sim_backends.network.packets import Packet
from sim_backends.radio.core.random_streams import PacketIdentity


@dataclass(frozen=True, slots=True)
class IpPacket:
    """A packet of the internet protocol, before any fragmentation.

    Attributes:
        source: Name of the sender.
        destination: Name of the receiver; None for all stations (multicast).
        transport: Name of the transport to which it belongs.
        size_bytes: Its size with the IP header.
        identity: Identity from which its random numbers are derived; a retransmission has another identity.
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
        """Call `call` on a host at `at_ns`, which is not in the past; if the host is off, call when it is on again.

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
        """Send a program's packet; this is called at its source at the time of sending."""
        ...

    def receive(self, host: str, packet: IpPacket) -> None:
        """Process an IP packet of this transport that has arrived, complete, at `host` now."""
        ...

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Record, for statistics only, that an IP packet or a fragment of it will not arrive at its destination.

        The ends of a real connection do not have this information, so it must not change their behaviour.
        """
        ...


@runtime_checkable
class CountsMisses(Transport, Protocol):
    """A transport that also records which hosts miss a broadcast."""

    def record_miss(self, packet: IpPacket, host: str, reason: str) -> None:
        """Record, like `record_loss`, that a packet without a single destination will not arrive at a host."""
        ...


class WireTimer:
    """Calls a function once at its due time, unless it is stopped or rescheduled before.

    When the timer is postponed, as by every ACK, no further call is scheduled on the wire. The call that is already
    scheduled schedules the next one when it fires.

    Args:
        wire: The wire that provides the clock.
        host: The host of the timer; the timer does not fire while the host is off.
        call: The function that is called.

    Attributes:
        due_ns: Due time; None while the timer is stopped.
    """

    def __init__(self, wire: Wire, host: str, call: Callable[[], None]) -> None:
        self._wire = wire
        self._host = host
        self._call = call
        self._scheduled_ns: int | None = None
        self.due_ns: int | None = None

    def set(self, at_ns: int) -> None:
        """Set the due time to `at_ns`, in place of an earlier due time."""
        self.due_ns = at_ns
        if self._scheduled_ns is None or self._scheduled_ns > at_ns:
            self._schedule(at_ns)

    def bring_forward(self, at_ns: int) -> None:
        """Set the due time to `at_ns`, or to now if that is in the past, unless the timer is due earlier."""
        at_ns = max(at_ns, self._wire.now_ns)
        if self.due_ns is None or at_ns < self.due_ns:
            self.set(at_ns)

    def stop(self) -> None:
        """Stop the timer until it is set again."""
        self.due_ns = None

    def _schedule(self, at_ns: int) -> None:
        self._scheduled_ns = at_ns
        self._wire.at(at_ns, self._host, partial(self._fire, at_ns))

    def _fire(self, scheduled_ns: int) -> None:
        if scheduled_ns != self._scheduled_ns:
            return  # the timer was set to an earlier time, for which another call is scheduled
        self._scheduled_ns = None
        if self.due_ns is None:
            return
        if self.due_ns > self._wire.now_ns:
            self._schedule(self.due_ns)
            return
        self.due_ns = None
        self._call()
