"""The event-driven radio engine: packets in, packets out, at the nanosecond the models say.

It knows no clock and no socket. The caller brings the time, in integer nanoseconds that never decrease: the medium
reads it from the monotonic clock, a test or a co-simulation makes it up.
"""

import hashlib
import heapq
from collections.abc import Mapping
from typing import Generic, TypeVar

from sim_backends.radio import delay
from sim_backends.radio.delay import Delay
from sim_backends.radio.hop import Hop
from sim_backends.radio.parameters import LinkCounters, LinkParameters, Pair

Payload = TypeVar("Payload")

Delivery = tuple[int, str, Payload, str, Delay]
"""When a packet arrived, in ns, at whom, what it carries, from whom, and what it was delayed by on all its hops.

A bare tuple: one is made per packet.
"""

_Leg = tuple[Hop, Payload, int, bool, tuple[str, ...], str]
"""A packet on a hop: payload, size in bytes, whether the receiver of the hop keeps it, to whom it is sent on, and who
sent it at first."""


class Engine(Generic[Payload]):
    """Carries packets between stations over directed links.

    With a relay (the master topology) a packet between two other stations goes to the relay first and from there on,
    each hop with its own queue, rate, delay and loss; a broadcast of a station reaches the relay, which repeats it to
    everyone else. Without one, or to and from the relay itself, packets go directly. A broadcast is one packet per
    receiver, each with a fate of its own.

    Args:
        seed: Seed of all random draws: equal seeds, links and packets give equal fates.
        trace: Whether to hash every event for `digest`.
    """

    def __init__(self, seed: int, *, trace: bool = False) -> None:
        self._seed = seed
        self._relay: str | None = None
        self._known: dict[Pair, Hop] = {}
        self._hops: dict[str, dict[str, Hop]] = {}
        self._under_way: list[tuple[int, int, _Leg[Payload], Delay]] = []
        self._order = 0
        self._arrived: list[Delivery[Payload]] = []
        self._trace = hashlib.sha256() if trace else None

    def connect(self, links: Mapping[Pair, LinkParameters], relay: str | None = None) -> None:
        """Use `links`, per ordered pair of stations, and `relay`, from now on; links not named are gone.

        Packets on the air keep their fate; counters and random streams go on.
        """
        self._relay = relay
        self._hops = {}
        for (transmitter, receiver), parameters in links.items():
            hop = self._known.get((transmitter, receiver)) or Hop(transmitter, receiver, self._seed)
            hop.use(parameters)
            self._known[transmitter, receiver] = hop
            self._hops.setdefault(transmitter, {})[receiver] = hop

    def send(
        self,
        now_ns: int,
        source: str,
        payload: Payload,
        size_bytes: int,
        destination: str | None,
        *,
        before: Delay = 0,
    ) -> None:
        """Send a packet at `now_ns`; `destination` None is everyone, `before` what it was delayed by until now.

        Raises:
            KeyError: There is no link from `source` towards `destination`.
        """
        if self._under_way and self._under_way[0][0] <= now_ns:
            self._advance(now_ns)
        hops = self._hops[source]
        relay = self._relay
        if destination is None:
            if relay is None or relay == source:
                for hop in hops.values():
                    self._transmit(now_ns, (hop, payload, size_bytes, True, (), source), before)
            else:
                self._transmit(now_ns, (hops[relay], payload, size_bytes, True, tuple(hops), source), before)
        elif relay is None or relay in (source, destination):
            self._transmit(now_ns, (hops[destination], payload, size_bytes, True, (), source), before)
        else:
            self._transmit(now_ns, (hops[relay], payload, size_bytes, False, (destination,), source), before)

    def next_event_ns(self) -> int | None:
        """Return when `deliveries` has something to do next, None when nothing is under way."""
        return self._under_way[0][0] if self._under_way else None

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return what arrived up to `now_ns` and was not returned before, in order of arrival."""
        if self._under_way and self._under_way[0][0] <= now_ns:
            self._advance(now_ns)
        arrived, self._arrived = self._arrived, []
        return arrived

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return what happened on each link so far."""
        return {pair: hop.counters for pair, hop in self._known.items()}

    def digest(self) -> str:
        """Return a hash over every event so far, for comparing runs.

        Raises:
            ValueError: The engine was made without `trace`.
        """
        if self._trace is None:
            raise ValueError("the engine was made without trace=True")
        return self._trace.hexdigest()

    def _advance(self, now_ns: int) -> None:
        under_way = self._under_way
        while under_way and under_way[0][0] <= now_ns:
            at_ns, _, leg, delayed = heapq.heappop(under_way)
            self._arrive(at_ns, leg, delayed)

    def _transmit(self, now_ns: int, leg: _Leg[Payload], before: Delay) -> None:
        hop, _, size_bytes, _, _, _ = leg
        passage = hop.offer(now_ns, size_bytes)
        if self._trace is not None:
            event = (now_ns, hop.transmitter, hop.receiver, hop.sent, size_bytes, passage)
            self._trace.update(repr(event).encode())
        if passage is None:
            return
        at_ns, delayed = passage
        if before:
            delayed += before - delay.PACKET
        if at_ns <= now_ns:
            self._arrive(at_ns, leg, delayed)
            return
        self._order += 1
        heapq.heappush(self._under_way, (at_ns, self._order, leg, delayed))

    def _arrive(self, at_ns: int, leg: _Leg[Payload], delayed: Delay) -> None:
        hop, payload, size_bytes, keep, onward, source = leg
        hop.delivered += 1
        if keep:
            self._arrived.append((at_ns, hop.receiver, payload, source, delayed))
        if onward:
            hops = self._hops.get(hop.receiver, {})
            for name in onward:
                # The relay has no link to itself, and others may have left while the packet was on its way to it.
                if name in hops:
                    self._transmit(at_ns, (hops[name], payload, size_bytes, True, (), source), delayed)
