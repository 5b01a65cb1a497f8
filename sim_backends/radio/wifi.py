"""802.11 stations on one channel: contention (DCF), hidden stations, ACKs, retries, relaying by an access point.

The model is event-driven, computes with integer nanoseconds, and uses no clock and no socket. It implements
`radio_model.RadioModel`, in part in the subclass `WifiInWorld`. Frames between stations whose radios have the section
`phy` (802.11n and later) are aggregated, and may use RTS/CTS and access categories. Power save delays frames to
stations of an access point. Beacons have airtime only if the option `access_points` is used; fragmentation is not
modelled.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from itertools import permutations
from typing import Generic

from fieldkit.core.model import LinkSample
from sim_backends.radio.core.links import (
    PACKET,
    PROCESSING_NS,
    QUEUE_FULL,
    Delay,
    Delivery,
    LinkCounters,
    LossLog,
    Pair,
    Payload,
)
from sim_backends.radio.core.random_streams import PacketIdentity, RandomStream
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.driver_statistics import RadioMeter, link_samples
from sim_backends.radio.mac.frame_exchange import FrameExchange
from sim_backends.radio.mac.frames import Frame, TransmissionAttempt
from sim_backends.radio.mac.packet_delivery import PacketDelivery
from sim_backends.radio.mac.power_save import BEACON_INTERVAL_NS, DTIM_PERIOD, PowerSave
from sim_backends.radio.mac.stations import Station
from sim_backends.radio.phy.modes import SHORT_RETRY_LIMIT
from sim_backends.radio.phy.transmissions import Emission


class Wifi(Generic[Payload]):
    """Stations that share one channel.

    Args:
        channel: Received powers between the stations.
        seed: Seed of all random draws.
        queue_packets: Maximum number of packets in each queue of a station, without the first.
        make_delivery: Class that queues and delivers the packets.
    """

    def __init__(
        self,
        channel: RadioChannel,
        seed: int,
        *,
        queue_packets: int = 1000,
        make_delivery: type[PacketDelivery[Payload]] = PacketDelivery,
    ) -> None:
        self._channel = channel
        self._index = {name: index for index, name in enumerate(channel.names)}
        self._off: Set[str] = frozenset()
        self._robots: Sequence[int] = range(len(channel.names))
        self._linked_names: Sequence[str] = channel.names
        self._relay: int | None = None
        self._exchange: FrameExchange[Payload] = FrameExchange(channel, seed, queue_packets, make_delivery)
        self._stations, self._events = self._exchange.stations, self._exchange.events
        self._delivery = self._exchange.delivery
        self._queue_packets = queue_packets
        # Stations with a slow bus: the time that the bus needs per packet, and the time from which the bus is free.
        indices = range(len(channel.names))
        self._packet_times_ns = {index: time_ns for index in indices if (time_ns := channel.packet_time_ns(index))}
        self._bus_free_ns: dict[int, int] = {}
        timeouts_ns = {
            index: timeout_ns
            for index in range(len(channel.names))
            if (timeout_ns := channel.power_save_timeout_ns(index)) is not None
        }
        if timeouts_ns:
            phase_ns = int(RandomStream(seed, "beacon").draw(0) * DTIM_PERIOD * BEACON_INTERVAL_NS)
            self._delivery.power_save = PowerSave(timeouts_ns, phase_ns, self._events, self._delivery.enqueue_now)

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Pass every transmission attempt that ends from now on to `log`; None stops logging."""
        exchange = self._exchange
        exchange.log = exchange.rts_cts.log = exchange.acknowledgements.log = log

    def log_losses(self, log: LossLog | None) -> None:
        """Pass every later loss to `log`; None stops logging."""
        self._delivery.log_loss = log

    def use_meter(self) -> None:
        """Start the counters of the radio drivers, for `sample`."""
        exchange = self._exchange
        exchange.meter = exchange.rts_cts.meter = exchange.acknowledgements.meter = RadioMeter(len(self._stations))

    def sample(self, now_ns: int, utc_ns: int) -> dict[str, LinkSample]:
        """Implement `RadioModel.sample`."""
        self.advance(now_ns)
        meter = self._exchange.meter
        if meter is None:
            return {}
        peers, robots = self._delivery.peers, self._robots
        return link_samples(
            now_ns, utc_ns, self._channel, meter, peers, robots=robots, relay=self._relay, cells=self._cells()
        )

    def _cells(self) -> Mapping[int, int | None] | None:
        """Return the access point of each robot, by index; None if they do not roam."""
        return None

    def switch_off(self, now_ns: int, names: Set[str]) -> None:
        """Set the stations whose radios are off; the caller must also put them out of range of all others.

        Frames queued at a station that is switched off are lost, and its current transmission is aborted.
        """
        self.advance(now_ns)
        for name in sorted(names - self._off):
            station = self._stations[self._index[name]]
            self._exchange.abort(now_ns, station)
            self._delivery.discard_queue(now_ns, station)
        self._off = frozenset(names)

    def set_emissions(self, now_ns: int, emissions: Mapping[str, Emission]) -> None:
        """Set the noise of jammers on the air until the next call, by name of the jammer."""
        self.advance(now_ns)
        self._exchange.reception.set_emissions(now_ns, emissions)
        if not emissions:
            for station in self._stations:
                self._exchange.retry_when_idle(now_ns, station)

    def set_relay(self, name: str | None) -> None:
        """Set the station that is the access point; None for direct links."""
        self._relay = None if name is None else self._index[name]
        if self._delivery.power_save is not None:
            self._delivery.power_save.access_points = () if self._relay is None else (self._relay,)

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return the current counters of each hop; a broadcast counts as one frame per station in range."""
        names = self._channel.names
        pairs = dict.fromkeys(permutations(self._linked_names, 2), LinkCounters(0, 0, 0, 0))
        for (transmitter, receiver), peer in self._delivery.peers.items():
            pair = names[transmitter], names[receiver]
            if pair in pairs:
                pairs[pair] = peer.counters
        return pairs

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
        max_attempts: int = SHORT_RETRY_LIMIT,
        dscp: int = 0,
    ) -> None:
        """Implement `RadioModel.send`; after `max_attempts` on its first hop the packet is given up."""
        self.advance(now_ns)
        station = self._stations[self._index[source]]
        receiver = None if destination is None else self._index[destination]
        identity = packet or (source, station.packet_count)
        station.packet_count += 1
        relay = self._relay
        if relay is None or relay in {station.index, receiver}:
            frame = Frame(payload, size_bytes, source, receiver, (), True, identity, now_ns, before)
        else:
            is_broadcast = receiver is None
            frame = Frame(payload, size_bytes, source, relay, (receiver,), is_broadcast, identity, now_ns, before)
        frame.max_attempts = max_attempts
        if dscp:
            frame.dscp = dscp
        if station.index in self._packet_times_ns:
            self._cross_bus(now_ns, station, frame)
            return
        self._delivery.enqueue(now_ns, station, frame)

    def _cross_bus(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        """Queue a packet after the bus and driver of its sender have processed it and the packets before it.

        The packet is lost if more packets than the queue can contain wait for the bus.
        """
        time_ns = self._packet_times_ns[station.index]
        ready_ns = max(now_ns, self._bus_free_ns.get(station.index, 0)) + time_ns
        if ready_ns - now_ns > (self._queue_packets + 1) * time_ns:
            self._delivery.lose(now_ns, station.index, frame, QUEUE_FULL)
            return
        self._bus_free_ns[station.index] = frame.queued_ns = ready_ns
        frame.before = (frame.before or PACKET) + PROCESSING_NS * (ready_ns - now_ns)
        self._events.schedule(ready_ns, self._delivery.enqueue, station, frame)

    def next_event_ns(self) -> int | None:
        """Return the time of the next event that `deliveries` processes, or None if there is none."""
        return self._events.next_ns()

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return the packets that arrived up to `now_ns` and were not returned before, in order of arrival."""
        self.advance(now_ns)
        deliveries, self._delivery.deliveries = self._delivery.deliveries, []
        return deliveries

    def advance(self, now_ns: int) -> None:
        """Run all events up to `now_ns`."""
        self._events.advance(now_ns)
