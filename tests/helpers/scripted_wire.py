"""A wire for transports in tests: a fixed delay, a rate, and what becomes of each packet written down beforehand."""

import heapq
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from sim_backends.network.packets import Packet
from sim_backends.network.wire import IpPacket, Transport

Script = Callable[[IpPacket, str, int], Sequence[int]]
"""What becomes of a packet, by the packet, its receiver, and which it is, from 0, of all between these two that way.

The answer is by how much longer than the wire's delay each copy takes that arrives, in ns: `(0,)` is as sent, `()` is
lost, `(0, 5)` is twice, the copy 5 ns later.
"""

_SECOND_NS = 1_000_000_000


def losing(numbers: Mapping[str, Collection[int]]) -> Script:
    """Return the script that loses, per source, the packets with these numbers and no others."""
    return lambda packet, _, number: () if number in numbers.get(packet.source, ()) else (0,)


@dataclass(frozen=True)
class Transmitted:
    """An IP packet that a transport sent.

    Attributes:
        at_ns: When it was handed to the wire.
        packet: What it was.
        arrived: Whether a copy of it arrives.
    """

    at_ns: int
    packet: IpPacket
    arrived: bool


class ScriptedWire:
    """A `Wire` that keeps an account of everything.

    Packets from one host to another go on a line of their own, one after the other at the rate, then take the delay.

    Args:
        delay_ns: From the end of a packet's serialization to its arrival.
        rate_bit_s: Of each line; None is unlimited.
        queue_packets: How many packets wait on a line beside the one that is sent; None is any number.
        script: What becomes of each packet; None is that each arrives once.
        hosts: Who gets what is sent to everyone.

    Attributes:
        now_ns: Now.
        transports: Whom arriving packets are handed to, by name; to be filled in by the test.
        transmitted: All that was sent, in order.
        delivered: When each program's packet was delivered, in order.
        dropped: Why each program's packet was dropped.
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
        """See `Wire.transmit`."""
        receivers = self._hosts if packet.destination is None else [packet.destination]
        arrived = [self._put(packet, receiver) for receiver in receivers if receiver != packet.source]
        self.transmitted.append(Transmitted(self.now_ns, packet, any(arrived)))

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """See `Wire.at`; of calls at the same time the one planned first comes first."""
        assert isinstance(at_ns, int)
        assert at_ns >= self.now_ns, "planned for the past"
        self._order += 1
        heapq.heappush(self._calls, (at_ns, self._order, call))

    def deliver(self, packet_id: int) -> None:
        """See `Wire.deliver`."""
        assert packet_id not in self.delivered, "delivered twice"
        assert packet_id not in self.dropped, "delivered after it was dropped"
        self.delivered[packet_id] = self.now_ns

    def drop(self, packet_id: int, reason: str) -> None:
        """See `Wire.drop`."""
        assert packet_id not in self.dropped, "dropped twice"
        if packet_id not in self.delivered:
            self.dropped[packet_id] = reason

    def next_event_ns(self) -> int | None:
        """Return when something happens next, None when nothing is planned."""
        return self._calls[0][0] if self._calls else None

    def run(self, until_ns: int | None = None) -> None:
        """Let everything happen up to `until_ns`, or until nothing is planned any more."""
        while self._calls and (until_ns is None or self._calls[0][0] <= until_ns):
            self.now_ns, _, call = heapq.heappop(self._calls)
            call()
        if until_ns is not None:
            self.now_ns = max(self.now_ns, until_ns)

    def send_at(self, at_ns: int, packet: Packet) -> None:
        """Let a program send a packet at `at_ns`, by the transport that the packet names."""
        self.at(at_ns, packet.source, lambda: self.transports[packet.protocol].send(packet))

    def _put(self, packet: IpPacket, receiver: str) -> bool:
        """Put a packet on the line to one receiver; return whether it arrives."""
        line = packet.source, receiver
        number = self._counts.get(line, 0)
        self._counts[line] = number + 1
        ends_ns = self._ends_ns.setdefault(line, [])
        while ends_ns and ends_ns[0] <= self.now_ns:
            ends_ns.pop(0)
        # The first of those on the line is being sent, the others wait.
        full = self._queue_packets is not None and len(ends_ns) > self._queue_packets
        later_ns = () if full else self._script(packet, receiver, number)
        end_ns = self.now_ns
        if self._rate_bit_s is not None and not full:
            begun_ns = ends_ns[-1] if ends_ns else self.now_ns
            end_ns = begun_ns - (-8 * packet.size_bytes * _SECOND_NS // self._rate_bit_s)
            ends_ns.append(end_ns)
        transport = self.transports[packet.transport]
        arrives_ns = end_ns + self._delay_ns
        for extra_ns in later_ns:
            self.at(arrives_ns + extra_ns, receiver, lambda: transport.receive(receiver, packet))
        if not later_ns:
            reason = "queue full" if full else "lost by script"
            self.at(arrives_ns, receiver, lambda: transport.lost(packet, reason))
        return bool(later_ns)
