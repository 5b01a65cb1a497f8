"""A wire for tests of transports, with a constant delay, a rate, and a script for the fate of each packet."""

import heapq
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from sim_backends.network.packets import Packet
from sim_backends.network.wire import IpPacket, Transport

Script = Callable[[IpPacket, str, int], Sequence[int]]
"""The fate of a packet, from the packet, its receiver, and its index (from 0) among all packets of this direction.

The result has one entry per copy that arrives: its delay in ns in addition to the delay of the wire. `(0,)` is a
normal delivery, `()` is a loss, and `(0, 5)` is a duplicate that arrives 5 ns later.
"""

_SECOND_NS = 1_000_000_000


def lose_packets(numbers: Mapping[str, Collection[int]]) -> Script:
    """A script that loses only the packets with the given indices of each source."""
    return lambda packet, _, number: () if number in numbers.get(packet.source, ()) else (0,)


@dataclass(frozen=True)
class Transmitted:
    """An IP packet sent by a transport.

    Attributes:
        at_ns: The time at which it was passed to the wire.
        packet: The packet.
        arrived: True if at least one copy arrives.
    """

    at_ns: int
    packet: IpPacket
    arrived: bool


class ScriptedWire:
    """A `Wire` that records all packets.

    Each pair of source and destination has a separate link, on which packets are serialized at the rate and then
    delayed.

    Args:
        delay_ns: Delay from the end of a packet's serialization to its arrival.
        rate_bit_s: Rate of each link; None is unlimited.
        queue_packets: Maximum number of packets that wait on a link, without the one being sent; None is unlimited.
        script: The fate of each packet; None delivers each once.
        hosts: The receivers of broadcasts.

    Attributes:
        now_ns: The present time.
        transports: Transports by name, which receive arriving packets; filled by the test.
        transmitted: All sent packets, in order.
        delivered: Delivery time of each program packet, in order.
        dropped: Drop reason of each program packet.
    """

    def __init__(
        self,
        delay_ns: int,
        *,
        rate_bit_s: int | None = None,
        queue_packets: int | None = None,
        script: Script | None = None,
        hosts: Sequence[str] = (),
    ) -> None:
        self.now_ns = 0
        self.transports: dict[str, Transport] = {}
        self.transmitted: list[Transmitted] = []
        self.delivered: dict[int, int] = {}
        self.dropped: dict[int, str] = {}
        self._delay_ns = delay_ns
        self._rate_bit_s = rate_bit_s
        self._queue_packets = queue_packets
        self._script = script or (lambda *_: (0,))
        self._hosts = hosts
        self._counts: dict[tuple[str, str], int] = {}
        self._ends_ns: dict[tuple[str, str], list[int]] = {}
        self._calls: list[tuple[int, int, Callable[[], None]]] = []
        self._order = 0

    def transmit(self, packet: IpPacket) -> None:
        """Implement `Wire.transmit`."""
        receivers = self._hosts if packet.destination is None else [packet.destination]
        arrived = [self._enqueue(packet, receiver) for receiver in receivers if receiver != packet.source]
        self.transmitted.append(Transmitted(self.now_ns, packet, any(arrived)))

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """Implement `Wire.at`; calls for the same time run in the order of scheduling."""
        assert isinstance(at_ns, int)
        assert at_ns >= self.now_ns, "scheduled in the past"
        self._order += 1
        heapq.heappush(self._calls, (at_ns, self._order, call))

    def deliver(self, packet_id: int) -> None:
        """Implement `Wire.deliver`."""
        assert packet_id not in self.delivered, "delivered twice"
        assert packet_id not in self.dropped, "delivered after it was dropped"
        self.delivered[packet_id] = self.now_ns

    def drop(self, packet_id: int, reason: str) -> None:
        """Implement `Wire.drop`."""
        assert packet_id not in self.dropped, "dropped twice"
        if packet_id not in self.delivered:
            self.dropped[packet_id] = reason

    def next_event_ns(self) -> int | None:
        """The time of the next event, or None if no event is scheduled."""
        return self._calls[0][0] if self._calls else None

    def run(self, until_ns: int | None = None) -> None:
        """Run all events up to `until_ns`, or all events if None."""
        while self._calls and (until_ns is None or self._calls[0][0] <= until_ns):
            self.now_ns, _, call = heapq.heappop(self._calls)
            call()
        if until_ns is not None:
            self.now_ns = max(self.now_ns, until_ns)

    def send_at(self, at_ns: int, packet: Packet) -> None:
        """Schedule the sending of a program's packet by the transport that the packet names."""
        self.at(at_ns, packet.source, lambda: self.transports[packet.protocol].send(packet))

    def _enqueue(self, packet: IpPacket, receiver: str) -> bool:
        """Put a packet on the link to one receiver; return True if it arrives."""
        link = packet.source, receiver
        number = self._counts.get(link, 0)
        self._counts[link] = number + 1
        ends_ns = self._ends_ns.setdefault(link, [])
        while ends_ns and ends_ns[0] <= self.now_ns:
            ends_ns.pop(0)
        # The first packet on the link is being sent, and the others wait.
        is_full = self._queue_packets is not None and len(ends_ns) > self._queue_packets
        extra_delays_ns = () if is_full else self._script(packet, receiver, number)
        end_ns = self.now_ns
        if self._rate_bit_s is not None and not is_full:
            start_ns = ends_ns[-1] if ends_ns else self.now_ns
            end_ns = start_ns - (-8 * packet.size_bytes * _SECOND_NS // self._rate_bit_s)
            ends_ns.append(end_ns)
        transport = self.transports[packet.transport]
        arrival_ns = end_ns + self._delay_ns
        for extra_ns in extra_delays_ns:
            self.at(arrival_ns + extra_ns, receiver, lambda: transport.receive(receiver, packet))
        if not extra_delays_ns:
            reason = "queue full" if is_full else "lost by script"
            self.at(arrival_ns, receiver, lambda: transport.record_loss(packet, reason))
        return bool(extra_delays_ns)
