"""Links that do the same wherever stations stand: each a queue, a rate, a delay and a loss.

The model knows no clock and no socket. The caller brings the time, in integer nanoseconds that never decrease: the
medium reads it from the monotonic clock, a test or a co-simulation makes it up.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from itertools import permutations
from typing import Generic

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import LinkSample, StationSample, Vector
from sim_backends.radio import delay
from sim_backends.radio.delay import Delay, Delivery, Payload
from sim_backends.radio.frames import TransmissionAttempt
from sim_backends.radio.jamming import Emitter
from sim_backends.radio.links import LinkCounters, LinkParameters, Pair
from sim_backends.radio.losses import LOST, OUT_OF_RANGE, QUEUE_FULL, RADIO_OFF, LossLog
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.random_streams import PacketDraws, PacketIdentity


class FixedLink:
    """The state of one directed link.

    Packets wait in a bounded first-in-first-out queue, go on the air one after the other at the link's rate, and
    arrive after the link's delay. They never overtake each other, jitter or not, because an 802.11 receiver hands
    frames up in order (IEEE 802.11-2020, 5.1.3): one that drew less jitter than its predecessor waits for it.

    Args:
        transmitter: Who sends.
        receiver: Who receives.
        seed: Seed of the random streams, which are named by transmitter, receiver and purpose.
    """

    def __init__(self, transmitter: str, receiver: str, seed: int) -> None:
        self.transmitter = transmitter
        self.receiver = receiver
        self.sent = 0
        self.delivered = 0
        self._queue_dropped = 0
        self._lost = 0
        self._loss_draw = PacketDraws(seed, transmitter, receiver, "loss").draw
        self._jitter_draw = PacketDraws(seed, transmitter, receiver, "jitter").draw
        self._free_ns = 0
        self._last_arrival_ns = 0
        self._starts_ns: deque[int] = deque()
        self.use(LinkParameters())

    def use(self, parameters: LinkParameters) -> None:
        """Treat packets from now on as `parameters` say; those on their way keep their fate."""
        self._parameters = parameters
        # Few lengths occur, and computing these per packet costs more than looking them up.
        self._by_size: dict[int, tuple[int, Delay]] = {}

    def offer(self, now_ns: int, size_bytes: int, packet: PacketIdentity) -> tuple[int, Delay] | str:
        """Take a packet at `now_ns`, which never decreases.

        Args:
            now_ns: Now.
            size_bytes: Its size.
            packet: What its draws are keyed by.

        Returns:
            When it arrives, and its delay, whose parts sum up to the time until then; why, when it never arrives.
        """
        parameters = self._parameters
        transmission_ns, delayed = self._by_size.get(size_bytes) or self._look_up(size_bytes)
        arrival_ns = now_ns + transmission_ns + parameters.delay_ns
        if parameters.rate_bit_s is not None:
            queuing_ns = self._enqueue(now_ns, transmission_ns)
            if queuing_ns is None:
                return QUEUE_FULL
            if queuing_ns:
                arrival_ns += queuing_ns
                delayed += queuing_ns * delay.QUEUING_NS
        self.sent += 1
        if parameters.loss and self._loss_draw(packet) < parameters.loss:
            self._lost += 1
            return LOST
        extra_ns = int(self._jitter_draw(packet) * parameters.jitter_ns) if parameters.jitter_ns else 0
        if arrival_ns + extra_ns < self._last_arrival_ns:
            extra_ns = self._last_arrival_ns - arrival_ns
        if extra_ns:
            arrival_ns += extra_ns
            delayed += extra_ns * delay.PROPAGATION_NS
        self._last_arrival_ns = arrival_ns
        return arrival_ns, delayed

    def refuse(self) -> None:
        """Count a packet as lost that finds the link cut."""
        self.sent += 1
        self.lose()

    def empty(self, now_ns: int) -> None:
        """Let nothing wait for the link any more; what has left for it arrives after its delay and jitter at most."""
        parameters = self._parameters
        self._free_ns = now_ns
        self._starts_ns.clear()
        self._last_arrival_ns = min(self._last_arrival_ns, now_ns + parameters.delay_ns + parameters.jitter_ns)

    def lose(self) -> None:
        """Count one of the packets that were sent as lost."""
        self._lost += 1

    def _look_up(self, size_bytes: int) -> tuple[int, Delay]:
        """Return transmission in ns and delay without waiting of packets of a size; remember them."""
        parameters = self._parameters
        transmission_ns = parameters.serialization_ns(size_bytes)
        delayed = delay.PACKET + transmission_ns * delay.TRANSMISSION_NS + parameters.delay_ns * delay.PROPAGATION_NS
        known = self._by_size[size_bytes] = transmission_ns, delayed
        return known

    def _enqueue(self, now_ns: int, transmission_ns: int) -> int | None:
        """Return how long a packet waits until it goes on the air, None when the queue is full."""
        waiting = self._starts_ns
        while waiting and waiting[0] <= now_ns:
            waiting.popleft()
        start_ns = now_ns
        if self._free_ns > now_ns:
            if len(waiting) >= self._parameters.queue_packets:
                self._queue_dropped += 1
                return None
            start_ns = self._free_ns
            waiting.append(start_ns)
        self._free_ns = start_ns + transmission_ns
        return start_ns - now_ns

    @property
    def rate_bit_s(self) -> int | None:
        """Its rate now; None is unlimited."""
        return self._parameters.rate_bit_s

    @property
    def counters(self) -> LinkCounters:
        """What happened so far."""
        return LinkCounters(self.sent, self._queue_dropped, self._lost, self.delivered)


_OnLink = tuple[FixedLink, Payload, int, bool, tuple[str, ...], str, PacketIdentity]
"""A packet on one link: link, payload, size in bytes, whether the receiver keeps it, to whom it is sent on, who
sent it at first, and what its draws are keyed by."""


_UnderWay = tuple[int, int, _OnLink[Payload], Delay, Delay]
"""When it arrives, which it is of all, the packet, and what it is delayed by on this link and was before."""


class FixedLinks(Generic[Payload]):
    """Carries packets between stations over directed links.

    With a relay (the master topology) a packet between two other stations goes to the relay first and from there on,
    each hop with its own queue, rate, delay and loss; a broadcast of a station reaches the relay, which repeats it to
    everyone else. Without one, or to and from the relay itself, packets go directly. A broadcast is one packet per
    receiver, each with a fate of its own.

    Args:
        seed: Seed of all random draws: equal seeds, links and packets give equal fates.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._relay: str | None = None
        self._known_links: dict[Pair, FixedLink] = {}
        self._links: dict[str, dict[str, FixedLink]] = {}
        self._under_way: list[_UnderWay[Payload]] = []
        self._order = 0
        self._offered: dict[str, int] = {}
        self._arrived: list[Delivery[Payload]] = []
        self._log_loss: LossLog | None = None
        self._off: Set[str] = frozenset()
        self._cut: Set[Pair] = frozenset()

    def connect(self, links: Mapping[Pair, LinkParameters], relay: str | None = None) -> None:
        """Use `links`, per ordered pair of stations, and `relay`, from now on; links not named are gone.

        Packets on the air keep their fate; counters and random streams go on.
        """
        self._relay = relay
        self._links = {}
        for (transmitter, receiver), parameters in links.items():
            link = self._known_links.get((transmitter, receiver)) or FixedLink(transmitter, receiver, self._seed)
            link.use(parameters)
            self._known_links[transmitter, receiver] = link
            self._links.setdefault(transmitter, {})[receiver] = link

    def send(
        self,
        now_ns: int,
        source: str,
        payload: Payload,
        size_bytes: int,
        destination: str | None,
        *,
        packet: PacketIdentity | None = None,
        before: Delay = 0,
    ) -> None:
        """See `RadioModel.send`."""
        if self._under_way and self._under_way[0][0] <= now_ns:
            self._advance(now_ns)
        links = self._links[source]
        if packet is None:
            number = self._offered.get(source, 0)
            self._offered[source] = number + 1
            packet = source, number
        relay = self._relay
        if destination is None:
            if relay is None or relay == source:
                for link in links.values():
                    self._transmit(now_ns, (link, payload, size_bytes, True, (), source, packet), before)
            else:
                self._transmit(
                    now_ns, (links[relay], payload, size_bytes, True, tuple(links), source, packet), before
                )
        elif relay is None or relay in (source, destination):
            self._transmit(now_ns, (links[destination], payload, size_bytes, True, (), source, packet), before)
        else:
            self._transmit(now_ns, (links[relay], payload, size_bytes, False, (destination,), source, packet), before)

    def next_event_ns(self) -> int | None:
        """Return when `deliveries` has something to do next, None when nothing is under way."""
        return self._under_way[0][0] if self._under_way else None

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return what arrived up to `now_ns` and was not returned before, in order of arrival."""
        if self._under_way and self._under_way[0][0] <= now_ns:
            self._advance(now_ns)
        arrived, self._arrived = self._arrived, []
        return arrived

    def log_losses(self, log: LossLog | None) -> None:
        """Hand `log` every loss from now on, or nobody."""
        self._log_loss = log

    def disturb(self, now_ns: int, off: Set[str], cut: Set[Pair]) -> None:
        """See `RadioModel.disturb`; what has left its transmitter keeps its fate."""
        self._advance(now_ns)
        newly_off = off - self._off
        self._off, self._cut = off, cut | {(other, one) for one, other in cut}
        if not newly_off:
            return
        for link in self._known_links.values():
            if link.transmitter in newly_off:
                link.empty(now_ns)
        under_way, self._under_way = sorted(self._under_way), []
        for waiting in under_way:
            at_ns, _, packet, delayed, _ = waiting
            link = packet[0]
            if link.transmitter in newly_off and at_ns - delay.parts(delayed).propagation_ns > now_ns:
                link.lose()
                self._lose(now_ns, packet, RADIO_OFF)
            else:
                self._under_way.append(waiting)

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return what happened on each link so far."""
        return {pair: link.counters for pair, link in self._known_links.items()}

    def use_meter(self) -> None:
        """See `RadioModel.use_meter`; these links count without being told."""

    def sample(self, now_ns: int, utc_ns: int) -> dict[str, LinkSample]:
        """See `RadioModel.sample`; there are no powers, no attempts, and no channel that could be busy."""
        self._advance(now_ns)
        return {
            name: LinkSample(utc_ns, tuple(self._known(name, link) for link in links.values()))
            for name, links in self._links.items()
        }

    def _known(self, name: str, link: FixedLink) -> StationSample:
        other = link.receiver
        back = self._known_links.get((other, name))
        return StationSample(
            station=other,
            tx_rate_bit_s=link.rate_bit_s,
            rx_rate_bit_s=None if back is None else back.rate_bit_s,
            tx_packets=link.sent,
            rx_packets=0 if back is None else back.delivered,
        )

    def _advance(self, now_ns: int) -> None:
        under_way = self._under_way
        while under_way and under_way[0][0] <= now_ns:
            at_ns, _, packet, delayed, before = heapq.heappop(under_way)
            self._arrive(at_ns, packet, delayed + before)

    def _transmit(self, now_ns: int, packet: _OnLink[Payload], before: Delay) -> None:
        link, _, size_bytes, _, _, _, identity = packet
        if self._off or self._cut:
            ends = link.transmitter, link.receiver
            if ends in self._cut or not self._off.isdisjoint(ends):
                link.refuse()
                self._lose(now_ns, packet, OUT_OF_RANGE)
                return
        passage = link.offer(now_ns, size_bytes, identity)
        if isinstance(passage, str):
            self._lose(now_ns, packet, passage)
            return
        at_ns, delayed = passage
        if before:
            before -= delay.PACKET
        if at_ns <= now_ns:
            self._arrive(at_ns, packet, delayed + before)
            return
        self._order += 1
        heapq.heappush(self._under_way, (at_ns, self._order, packet, delayed, before))

    def _arrive(self, at_ns: int, packet: _OnLink[Payload], delayed: Delay) -> None:
        link, payload, size_bytes, keep, onward, source, identity = packet
        link.delivered += 1
        if keep:
            self._arrived.append((at_ns, link.receiver, payload, source, delayed))
        if onward:
            links = self._links.get(link.receiver, {})
            for name in onward:
                # The relay has no link to itself, and others may have left while the packet was on its way to it.
                if name in links:
                    self._transmit(at_ns, (links[name], payload, size_bytes, True, (), source, identity), delayed)
                elif self._log_loss is not None and name != link.receiver:
                    self._log_loss(at_ns, payload, name, OUT_OF_RANGE)

    def _lose(self, now_ns: int, packet: _OnLink[Payload], reason: str) -> None:
        """Tell that a packet does not pass its link, for everyone whom it would have reached."""
        if self._log_loss is None:
            return
        link, payload, _, keep, onward, _, _ = packet
        for name in dict.fromkeys((link.receiver, *onward) if keep else onward):
            self._log_loss(now_ns, payload, name, reason)


def mesh(options: RadioOptions, names: Iterable[str]) -> dict[Pair, LinkParameters]:
    """Return the fixed links between all stations `names`, in both directions."""
    return dict.fromkeys(permutations(names, 2), options.link())


class UniformLinks(FixedLinks[Payload]):
    """Links that do the same wherever stations stand.

    Args:
        seed: Of all random draws.
        options: What every link does.
    """

    def __init__(self, seed: int, options: RadioOptions) -> None:
        super().__init__(seed)
        self._options = options
        self._placed: tuple[frozenset[str], str | None] | None = None

    def place(
        self,
        now_ns: int,  # noqa: ARG002 (see RadioModel)
        places_m: Mapping[str, Vector],
        relay: str | None,
        velocities_m_s: Mapping[str, Vector] | None = None,  # noqa: ARG002
    ) -> None:
        """See `RadioModel.place`."""
        placed = frozenset(places_m), relay
        if placed != self._placed:
            self._placed = placed
            self.connect(mesh(self._options, places_m), relay)

    def jam(self, now_ns: int, emitters: Sequence[Emitter]) -> None:  # noqa: ARG002 (see RadioModel)
        """See `RadioModel.jam`."""
        if emitters:
            raise ConfigurationError(
                "fixed links hear no jammer",
                remedy="leave the jammer out, or loss, delay, rate and jitter of the radio",
            )

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """See `RadioModel.log_attempts`."""
