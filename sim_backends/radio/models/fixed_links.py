"""Links that behave the same at all positions of the stations: each has a queue, a rate, a delay and a loss.

The model uses no clock and no socket. The caller passes the time in integer nanoseconds, which must not decrease. In
an emulated lab the time is read from the monotonic clock; tests and co-simulations use virtual time.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from itertools import permutations
from typing import Generic

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import LinkSample, StationSample, Vector
from sim_backends.radio.core.links import (
    LOST,
    OUT_OF_RANGE,
    PACKET,
    PROPAGATION_NS,
    QUEUE_FULL,
    QUEUING_NS,
    RADIO_OFF,
    TRANSMISSION_NS,
    Delay,
    Delivery,
    LinkCounters,
    LinkParameters,
    LossLog,
    Pair,
    Payload,
    delay_parts,
)
from sim_backends.radio.core.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.mac.channel import Emitter
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import Attitude


class FixedLink:
    """The state of one directed link.

    Packets wait in a bounded first-in-first-out queue, are sent one after the other at the link's rate, and arrive
    after the link's delay. Packets never overtake each other, even with jitter, because an 802.11 receiver delivers
    frames in order (IEEE 802.11-2020, 5.1.3): a packet with less jitter than its predecessor waits for it.

    Args:
        transmitter: Name of the sending station.
        receiver: Name of the receiving station.
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
        # Time from which the link is free, and start times of the transmissions of queued packets.
        self._free_ns = 0
        self._starts_ns: deque[int] = deque()
        self._last_arrival_ns = 0
        self.set_parameters(LinkParameters())

    def set_parameters(self, parameters: LinkParameters) -> None:
        """Set the parameters for later packets; packets in flight are not affected."""
        self._parameters = parameters
        # Few sizes occur, and computing these values for each packet costs more than a lookup.
        self._by_size: dict[int, tuple[int, Delay]] = {}

    def accept(self, now_ns: int, size_bytes: int, packet: PacketIdentity) -> tuple[int, Delay] | str:
        """Accept a packet at `now_ns`, which never decreases.

        Args:
            now_ns: Current time.
            size_bytes: Size of the packet.
            packet: Identity that keys its random draws.

        Returns:
            Arrival time and delay (its parts add up to the time until the arrival); or the reason why the packet is
            lost.
        """
        parameters = self._parameters
        transmission_ns, delay_sum = self._by_size.get(size_bytes) or self._compute_delays(size_bytes)
        arrival_ns = now_ns + transmission_ns + parameters.delay_ns
        if parameters.rate_bit_s is not None:
            queuing_ns = self._enqueue(now_ns, transmission_ns)
            if queuing_ns is None:
                return QUEUE_FULL
            if queuing_ns:
                arrival_ns += queuing_ns
                delay_sum += queuing_ns * QUEUING_NS
        self.sent += 1
        if parameters.loss and self._loss_draw(packet) < parameters.loss:
            self._lost += 1
            return LOST
        extra_ns = int(self._jitter_draw(packet) * parameters.jitter_ns) if parameters.jitter_ns else 0
        if arrival_ns + extra_ns < self._last_arrival_ns:
            extra_ns = self._last_arrival_ns - arrival_ns
        if extra_ns:
            arrival_ns += extra_ns
            delay_sum += extra_ns * PROPAGATION_NS
        self._last_arrival_ns = arrival_ns
        return arrival_ns, delay_sum

    def count_cut(self) -> None:
        """Count a packet as lost because the link is cut or a radio is off."""
        self.sent += 1
        self.count_lost()

    def clear_queue(self, now_ns: int) -> None:
        """Empty the queue; the removed packets do not delay later packets."""
        parameters = self._parameters
        self._free_ns = now_ns
        self._starts_ns.clear()
        self._last_arrival_ns = min(self._last_arrival_ns, now_ns + parameters.delay_ns + parameters.jitter_ns)

    def count_lost(self) -> None:
        """Count one of the sent packets as lost."""
        self._lost += 1

    def _compute_delays(self, size_bytes: int) -> tuple[int, Delay]:
        """Return the transmission time in ns and the delay without queuing for a packet size; cache them."""
        parameters = self._parameters
        transmission_ns = parameters.serialization_ns(size_bytes)
        delay_sum = PACKET + transmission_ns * TRANSMISSION_NS + parameters.delay_ns * PROPAGATION_NS
        entry = self._by_size[size_bytes] = transmission_ns, delay_sum
        return entry

    def _enqueue(self, now_ns: int, transmission_ns: int) -> int | None:
        """Return the time that a packet waits before its transmission, in ns, or None if the queue is full."""
        starts_ns = self._starts_ns
        while starts_ns and starts_ns[0] <= now_ns:
            starts_ns.popleft()
        start_ns = now_ns
        if self._free_ns > now_ns:
            if len(starts_ns) >= self._parameters.queue_packets:
                self._queue_dropped += 1
                return None
            start_ns = self._free_ns
            starts_ns.append(start_ns)
        self._free_ns = start_ns + transmission_ns
        return start_ns - now_ns

    @property
    def rate_bit_s(self) -> int | None:
        """The current rate; None means unlimited."""
        return self._parameters.rate_bit_s

    @property
    def counters(self) -> LinkCounters:
        """The current counters."""
        return LinkCounters(self.sent, self._queue_dropped, self._lost, self.delivered)


_LinkPacket = tuple[FixedLink, Payload, int, bool, tuple[str, ...], str, PacketIdentity]
"""A packet on one link: link, payload, size in bytes, True if it is delivered to the receiver of the link, stations
to which it is forwarded, original source, and identity that keys its random draws.
"""


_InFlight = tuple[int, int, _LinkPacket[Payload], Delay, Delay]
"""Arrival time, sequence number, packet, its delay on this link, and its delay before this link."""


class FixedLinks(Generic[Payload]):
    """Carries packets between stations over directed links.

    With a relay (the master topology) a packet between two other stations is sent to the relay first and forwarded
    from there; each hop has its own queue, rate, delay and loss. A broadcast of a station reaches the relay, which
    repeats it to all other stations. Without a relay, and to and from the relay itself, packets are sent directly. A
    broadcast is one packet per receiver, each with its own random draws; on the hop to the relay it is one packet.

    Args:
        seed: Seed of all random draws: equal seeds, links and packets give equal results.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._relay: str | None = None
        self._all_links: dict[Pair, FixedLink] = {}
        self._links: dict[str, dict[str, FixedLink]] = {}
        self._in_flight: list[_InFlight[Payload]] = []
        self._order = 0
        self._packet_counts: dict[str, int] = {}
        self._deliveries: list[Delivery[Payload]] = []
        self._log_loss: LossLog | None = None
        self._off: Set[str] = frozenset()
        self._cut: Set[Pair] = frozenset()

    def connect(self, links: Mapping[Pair, LinkParameters], relay: str | None = None) -> None:
        """Set the links, by ordered pair of stations, and the relay; links that are not named are removed.

        Packets in flight are not affected; counters and random streams continue.
        """
        self._relay = relay
        self._links = {}
        for (transmitter, receiver), parameters in links.items():
            link = self._all_links.get((transmitter, receiver)) or FixedLink(transmitter, receiver, self._seed)
            link.set_parameters(parameters)
            self._all_links[transmitter, receiver] = link
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
        dscp: int = 0,  # noqa: ARG002 (see RadioModel)
    ) -> None:
        """Implement `RadioModel.send`."""
        if self._in_flight and self._in_flight[0][0] <= now_ns:
            self._advance(now_ns)
        links = self._links[source]
        if packet is None:
            number = self._packet_counts.get(source, 0)
            self._packet_counts[source] = number + 1
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
        """Return the time of the next event for `deliveries`, or None if no packet is in flight."""
        return self._in_flight[0][0] if self._in_flight else None

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return the packets that arrived up to `now_ns` and were not returned before, in order of arrival."""
        if self._in_flight and self._in_flight[0][0] <= now_ns:
            self._advance(now_ns)
        deliveries, self._deliveries = self._deliveries, []
        return deliveries

    def log_losses(self, log: LossLog | None) -> None:
        """Pass every later loss to `log`; None stops logging."""
        self._log_loss = log

    def disturb(self, now_ns: int, off: Set[str], cut: Set[Pair]) -> None:
        """Implement `RadioModel.disturb`.

        Packets that have left their transmitter, and packets in the queue of a link that is cut, are not affected.
        """
        self._advance(now_ns)
        newly_off = off - self._off
        self._off, self._cut = off, cut | {(receiver, transmitter) for transmitter, receiver in cut}
        if not newly_off:
            return
        for link in self._all_links.values():
            if link.transmitter in newly_off:
                link.clear_queue(now_ns)
        in_flight, self._in_flight = sorted(self._in_flight), []
        for entry in in_flight:
            at_ns, _, packet, delay_sum, _ = entry
            link = packet[0]
            if link.transmitter in newly_off and at_ns - delay_parts(delay_sum).propagation_ns > now_ns:
                link.count_lost()
                self._lose(now_ns, packet, RADIO_OFF)
            else:
                self._in_flight.append(entry)

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return the current counters of each link, including removed links."""
        return {pair: link.counters for pair, link in self._all_links.items()}

    def use_meter(self) -> None:
        """Implement `RadioModel.use_meter`; fixed links always count."""

    def sample(self, now_ns: int, utc_ns: int) -> dict[str, LinkSample]:
        """Implement `RadioModel.sample`; there are no powers, no attempts and no channel busy time."""
        self._advance(now_ns)
        return {
            name: LinkSample(utc_ns, tuple(self._station_sample(name, link) for link in links.values()))
            for name, links in self._links.items()
        }

    def _station_sample(self, name: str, link: FixedLink) -> StationSample:
        peer = link.receiver
        reverse = self._all_links.get((peer, name))
        return StationSample(
            station=peer,
            tx_rate_bit_s=link.rate_bit_s,
            rx_rate_bit_s=None if reverse is None else reverse.rate_bit_s,
            tx_packets=link.sent,
            rx_packets=0 if reverse is None else reverse.delivered,
        )

    def _advance(self, now_ns: int) -> None:
        in_flight = self._in_flight
        while in_flight and in_flight[0][0] <= now_ns:
            at_ns, _, packet, delay_sum, before = heapq.heappop(in_flight)
            self._arrive(at_ns, packet, delay_sum + before)

    def _transmit(self, now_ns: int, packet: _LinkPacket[Payload], before: Delay) -> None:
        """Send a packet over its link, or log its loss."""
        link, _, size_bytes, _, _, _, identity = packet
        if self._off or self._cut:
            ends = link.transmitter, link.receiver
            if ends in self._cut or not self._off.isdisjoint(ends):
                link.count_cut()
                self._lose(now_ns, packet, OUT_OF_RANGE)
                return
        result = link.accept(now_ns, size_bytes, identity)
        if isinstance(result, str):
            self._lose(now_ns, packet, result)
            return
        at_ns, delay_sum = result
        if before:
            before -= PACKET  # `delay_sum` already counts the packet
        if at_ns <= now_ns:
            self._arrive(at_ns, packet, delay_sum + before)
            return
        self._order += 1
        heapq.heappush(self._in_flight, (at_ns, self._order, packet, delay_sum, before))

    def _arrive(self, at_ns: int, packet: _LinkPacket[Payload], delay_sum: Delay) -> None:
        link, payload, size_bytes, is_for_receiver, forward_to, source, identity = packet
        link.delivered += 1
        if is_for_receiver:
            self._deliveries.append((at_ns, link.receiver, payload, source, delay_sum))
        if forward_to:
            links = self._links.get(link.receiver, {})
            for name in forward_to:
                # The relay has no link to itself, and a station may have left while the packet was in flight to the
                # relay.
                if name in links:
                    self._transmit(at_ns, (links[name], payload, size_bytes, True, (), source, identity), delay_sum)
                elif self._log_loss is not None and name != link.receiver:
                    self._log_loss(at_ns, payload, name, OUT_OF_RANGE)

    def _lose(self, now_ns: int, packet: _LinkPacket[Payload], reason: str) -> None:
        """Log that a packet does not pass its link, for each station that it would have reached."""
        if self._log_loss is None:
            return
        link, payload, _, is_for_receiver, forward_to, _, _ = packet
        for name in dict.fromkeys((link.receiver, *forward_to) if is_for_receiver else forward_to):
            self._log_loss(now_ns, payload, name, reason)


def mesh(options: RadioOptions, names: Iterable[str]) -> dict[Pair, LinkParameters]:
    """Return fixed links between all stations in `names`, in both directions."""
    return dict.fromkeys(permutations(names, 2), options.link())


class UniformLinks(FixedLinks[Payload]):
    """Links between all stations that behave the same at all positions.

    Args:
        seed: Seed of all random draws.
        options: Parameters of every link.
    """

    uses_attitudes = False

    def __init__(self, seed: int, options: RadioOptions) -> None:
        super().__init__(seed)
        self._options = options
        self._stations: tuple[frozenset[str], str | None] | None = None

    def place(
        self,
        now_ns: int,  # noqa: ARG002 (see RadioModel)
        positions_m: Mapping[str, Vector],
        relay: str | None,
        velocities_m_s: Mapping[str, Vector] | None = None,  # noqa: ARG002
        attitudes: Mapping[str, Attitude] | None = None,  # noqa: ARG002
    ) -> None:
        """Implement `RadioModel.place`; only the set of stations and the relay matter."""
        stations = frozenset(positions_m), relay
        if stations != self._stations:
            self._stations = stations
            self.connect(mesh(self._options, positions_m), relay)

    def jam(self, now_ns: int, emitters: Sequence[Emitter]) -> None:  # noqa: ARG002 (see RadioModel)
        """Implement `RadioModel.jam`; fixed links support no jammers."""
        if emitters:
            raise ConfigurationError(
                "fixed links do not support jammers",
                remedy="remove the jammer, or remove loss, delay, rate and jitter of the radio",
            )

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Implement `RadioModel.log_attempts`; fixed links have no attempts."""
