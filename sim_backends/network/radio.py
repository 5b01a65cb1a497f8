"""The network of the co-simulation: transports, the internet protocol and a radio, in exact order of time."""

import heapq
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Vector
from sim_backends.network import ip
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss, active, changes_ns
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.network.udp import Udp
from sim_backends.network.wire import CountsMisses, IpPacket, Transport, Wire
from sim_backends.radio.core.links import RADIO_OFF, Delay
from sim_backends.radio.mac.channel import Emitter
from sim_backends.radio.models.radio_model import RadioModel
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import STILL, Attitude, State, attitude_of

TransportFactory = Callable[[Wire], Transport]

IpLog = Callable[[int, str, Fragment], None]
"""Called with the time, the host, and the packet or fragment that the host sent or received."""

DelayLog = Callable[[str, Fragment, Delay], None]
"""Called with the receiver, the packet or fragment, and its delay."""

UDP_ONLY: Final[Mapping[str, TransportFactory]] = MappingProxyType({"udp": Udp})


class RadioNetwork:
    """Carries packets of programs with transports over the internet protocol and a radio model.

    Events are processed in order of time. At the same nanosecond the order is: events of the radio; starts and ends
    of disturbances; timers of transports, in the order in which they were set; entering packets, in the given order.
    The immediate consequences of an event are processed before the next event.

    The radio receives the positions of stations when an event is processed, not at every window, so the result does
    not depend on earlier updates. It receives attitudes if it needs them, but no velocities: for the radio, stations
    stay at the coordinator's positions, or move in steps if the coordinator passes dead-reckoned states. The position
    error therefore depends only on the coordinator's sync policy. A station without a state is absent: its radio is
    off.

    `Transport.record_loss` is called only for packets with a single destination. For broadcasts, `CountsMisses`
    records the hosts that miss them.

    Args:
        radio: The radio model.
        names: The stations.
        transports: Factories of the transports, by the protocol name that packets use.
        disturbances: Radio disturbances.
        relay: Station whose access point relays between the others; None for direct links.

    Attributes:
        now_ns: Current simulated time.
        extrapolates: True, because dead-reckoned states are evaluated at the time of each event.
        transmitters: Stations whose positions matter for packets of others: the relay, and carriers of a jammer.
        fixed_emitters_m: Positions of the jammers that no agent carries.

    Raises:
        ConfigurationError: A node loss, a link cut or the relay names an unknown station.
    """

    def __init__(
        self,
        radio: RadioModel[Fragment],
        names: Sequence[str],
        *,
        transports: Mapping[str, TransportFactory] = UDP_ONLY,
        disturbances: Sequence[Disturbance] = (),
        relay: str | None = None,
    ) -> None:
        self.now_ns = 0
        self.extrapolates = True
        self._radio = radio
        self._names = tuple(names)
        self._relay = relay
        self._disturbances = tuple(disturbances)
        self._check_names()
        jammers = [disturbance for disturbance in disturbances if isinstance(disturbance, Jammer)]
        self.transmitters = frozenset({relay or "", *(jammer.agent for jammer in jammers)} - {""})
        self.fixed_emitters_m = tuple(jammer.position_m for jammer in jammers if jammer.position_m is not None)
        # Remaining start and end times of disturbances, latest first, so that the next one is removed from the end.
        self._changes_ns = changes_ns(disturbances)[::-1]
        self._stations_off: set[str] = set()
        self._absent_stations: frozenset[str] = frozenset()
        self._positions_m: dict[str, Vector] = {}
        self._attitudes: dict[str, Attitude] = {}
        self._jammers: dict[str, Jammer] = {}
        self._states: Mapping[str, State] = {}
        self._placed_states: Mapping[str, State] | None = None
        self._timers: list[tuple[int, int, str | None, Callable[[], None]]] = []
        # Timer calls of hosts that are off; they run when the host is on again.
        self._suspended_calls: list[tuple[str, Callable[[], None]]] = []
        self._timer_count = 0
        self._ip_ids = dict.fromkeys(names, 0)
        self._log_ip: IpLog | None = None
        self._log_delay: DelayLog | None = None
        self._reassembly = ip.Reassembly(self._on_packet_lost)
        self._pending_packets: dict[int, Packet] = {}
        self._arrivals: list[Arrival] = []
        self._drops: list[Drop] = []
        self._transports = {name: make(self) for name, make in transports.items()}
        self._counting_misses = {
            name: transport for name, transport in self._transports.items() if isinstance(transport, CountsMisses)
        }
        radio.log_losses(self._on_fragment_lost)

    def log_ip(self, log: IpLog | None) -> None:
        """Pass every packet or fragment that a host sends or receives from now on to `log`; None stops logging."""
        self._log_ip = log

    def log_delays(self, log: DelayLog | None) -> None:
        """Pass the delay of every packet or fragment that arrives from now on to `log`; None stops logging."""
        self._log_delay = log

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy, without the logs: events in a copy are not logged."""
        return self.__dict__ | {"_log_ip": None, "_log_delay": None}

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Implement `NetworkFederate.advance`.

        Raises:
            ConfigurationError: A packet names an unknown transport, or is too long for its transport.
        """
        self._states = states
        for packet in packets:
            self._run(packet.enters_ns)
            if self._place(packet.enters_ns):
                self._run(packet.enters_ns)
            self.now_ns = packet.enters_ns
            self._pending_packets[packet.packet_id] = packet
            self._transport(packet.protocol).send(packet)
            self._collect()
        self._run(to_ns)
        self.now_ns = max(self.now_ns, to_ns)
        arrivals, drops = self._arrivals, self._drops
        self._arrivals, self._drops = [], []
        return arrivals, drops

    def next_event_ns(self) -> int | None:
        """Implement `NetworkFederate.next_event_ns`."""
        at_ns = self._radio.next_event_ns()
        if self._timers and (at_ns is None or self._timers[0][0] < at_ns):
            at_ns = self._timers[0][0]
        if self._changes_ns and (at_ns is None or self._changes_ns[-1] < at_ns):
            at_ns = self._changes_ns[-1]
        return at_ns

    def transmit(self, packet: IpPacket) -> None:
        """Implement `Wire.transmit`; packets of a host to itself arrive immediately, even if its radio is off."""
        now_ns, source, destination = self.now_ns, packet.source, packet.destination
        ip_id = self._ip_ids[source]
        self._ip_ids[source] = ip_id + 1
        for fragment in ip.fragments(packet, ip_id):
            if self._log_ip is not None:
                self._log_ip(now_ns, source, fragment)
            if destination == source:
                self._schedule(now_ns, None, partial(self._receive, source, fragment))
            elif source in self._stations_off:
                for name in self._names if destination is None else (destination,):
                    if name != source:
                        self._reassembly.on_loss(name, fragment, RADIO_OFF)
            else:
                self._radio.send(now_ns, source, fragment, fragment.size_bytes, destination, packet=fragment.identity)

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """Implement `Wire.at`.

        Raises:
            ValueError: The time is in the past.
        """
        if at_ns < self.now_ns:
            raise ValueError(f"a timer was set for {at_ns} ns, which is before the current time, {self.now_ns} ns")
        self._schedule(at_ns, host, call)

    def deliver(self, packet_id: int) -> None:
        """Implement `Wire.deliver`."""
        packet = self._pending_packets.pop(packet_id, None)
        if packet is not None:
            self._arrivals.append(Arrival(packet_id, packet.destination, self.now_ns))

    def drop(self, packet_id: int, reason: str) -> None:
        """Implement `Wire.drop`."""
        if self._pending_packets.pop(packet_id, None) is not None:
            self._drops.append(Drop(packet_id, reason))

    def _run(self, to_ns: int) -> None:
        """Process all events up to `to_ns` in order."""
        while (at_ns := self.next_event_ns()) is not None and at_ns <= to_ns:
            if self._place(at_ns) and self.next_event_ns() != at_ns:
                continue  # the end of a jammer's noise may start a transmission, and an absence may cancel one
            self.now_ns = at_ns
            if self._radio.next_event_ns() != at_ns:
                if self._changes_ns and self._changes_ns[-1] == at_ns:
                    self._changes_ns.pop()
                    self._disturb(at_ns)
                else:
                    self._fire_timer()
            self._collect()

    def _schedule(self, at_ns: int, host: str | None, call: Callable[[], None]) -> None:
        """Schedule `call` for `at_ns`; if a host is given, the call waits while the host is off."""
        self._timer_count += 1
        heapq.heappush(self._timers, (at_ns, self._timer_count, host, call))

    def _fire_timer(self) -> None:
        """Run the next timer's call, or suspend it if its host is off."""
        _, _, host, call = heapq.heappop(self._timers)
        if host is not None and host in self._stations_off:
            self._suspended_calls.append((host, call))
        else:
            call()

    def _place(self, at_ns: int) -> bool:
        """Pass the positions of the stations at `at_ns`, the time of the next event, to the radio.

        Returns:
            False if the states are the same object as in the last call, which then changes nothing. If True, the next
            event of the radio may be a different one.
        """
        states = self._states.at(at_ns) if isinstance(self._states, DeadReckoned) else self._states
        if states is self._placed_states:
            return False
        self._placed_states = states
        absent_stations: frozenset[str] = frozenset()
        try:
            self._positions_m = {name: states[name].position_m for name in self._names}
        except KeyError:
            absent_stations = frozenset(name for name in self._names if name not in states)
            present_m = {name: states[name].position_m for name in self._names if name not in absent_stations}
            # The radio of an absent station is off; the station keeps its last position.
            self._positions_m = dict.fromkeys(self._names, STILL) | self._positions_m | present_m
        attitudes = self._update_attitudes(states) if self._radio.uses_attitudes else None
        self._radio.place(self.now_ns, self._positions_m, self._relay, attitudes=attitudes)
        if absent_stations != self._absent_stations:
            self._absent_stations = absent_stations
            if self._current_stations_off() != self._stations_off:
                self._disturb(at_ns)
        if self._jammers:
            self._jam()
        return True

    def _update_attitudes(self, states: Mapping[str, State]) -> Mapping[str, Attitude]:
        for name in self._names:
            if (state := states.get(name)) is not None:
                self._attitudes[name] = attitude_of(state, before=self._attitudes.get(name, Attitude()))
        return self._attitudes

    def _collect(self) -> None:
        """Pass the packets that the radio delivers now to their hosts, until it delivers no further packet now."""
        while deliveries := self._radio.deliveries(self.now_ns):
            for _, host, fragment, _, delay in deliveries:
                if self._log_delay is not None:
                    self._log_delay(host, fragment, delay)
                self._receive(host, fragment)

    def _receive(self, host: str, fragment: Fragment) -> None:
        if host in self._stations_off and host != fragment.packet.source:
            self._reassembly.on_loss(host, fragment, RADIO_OFF)
            return
        if self._log_ip is not None:
            self._log_ip(self.now_ns, host, fragment)
        if self._reassembly.on_arrival(self.now_ns, host, fragment):
            self._transports[fragment.packet.transport].receive(host, fragment.packet)

    def _on_fragment_lost(self, at_ns: int, fragment: Fragment, host: str, reason: str) -> None:  # noqa: ARG002 (see LossLog)
        self._reassembly.on_loss(host, fragment, reason)

    def _on_packet_lost(self, packet: IpPacket, host: str, reason: str) -> None:
        if packet.destination == host:
            self._transports[packet.transport].record_loss(packet, reason)
        elif packet.destination is None and packet.transport in self._counting_misses:
            self._counting_misses[packet.transport].record_miss(packet, host, reason)

    def _current_stations_off(self) -> set[str]:
        """Return the stations whose radios are off now."""
        active_now = active(self._disturbances, self.now_ns)
        return {
            disturbance.name for disturbance in active_now if isinstance(disturbance, NodeLoss)
        } | self._absent_stations

    def _disturb(self, resume_ns: int) -> None:
        """Apply the current disturbances; called when one starts or ends, and when the absent stations change.

        Args:
            resume_ns: Time from which the suspended timers of hosts that are on again fire.
        """
        active_now = active(self._disturbances, self.now_ns)
        stations_off = self._current_stations_off()
        cut_links = {(link.first, link.second) for link in active_now if isinstance(link, LinkCut)}
        newly_off_stations, self._stations_off = stations_off - self._stations_off, stations_off
        self._radio.disturb(self.now_ns, stations_off, cut_links)
        for host in sorted(newly_off_stations):
            self._reassembly.discard(host, RADIO_OFF)
        suspended_calls, self._suspended_calls = self._suspended_calls, []
        for host, call in suspended_calls:
            self._schedule(resume_ns, host, call)
        jammers = {f"jammer {jammer}": jammer for jammer in active_now if isinstance(jammer, Jammer)}
        if jammers or self._jammers:
            self._jammers = jammers
            self._jam()

    def _jam(self) -> None:
        states = self._states if self._placed_states is None else self._placed_states
        positions_m = {
            name: states[jammer.agent].position_m if jammer.position_m is None else jammer.position_m
            for name, jammer in self._jammers.items()
            if jammer.position_m is not None or jammer.agent in states
        }
        self._radio.jam(
            self.now_ns,
            [Emitter(name, position_m, self._jammers[name].power_dbm) for name, position_m in positions_m.items()],
        )

    def _transport(self, name: str) -> Transport:
        if name not in self._transports:
            raise ConfigurationError(
                f"there is no transport {name!r}",
                remedy=did_you_mean(name, self._transports, f"use one of {', '.join(self._transports)}"),
            )
        return self._transports[name]

    def _check_names(self) -> None:
        names = [] if self._relay is None else [self._relay]
        for disturbance in self._disturbances:
            if isinstance(disturbance, NodeLoss):
                names.append(disturbance.name)
            elif isinstance(disturbance, LinkCut):
                names += [disturbance.first, disturbance.second]
        for name in names:
            if name not in self._names:
                raise ConfigurationError(
                    f"there is no station {name!r}",
                    remedy=did_you_mean(name, self._names, f"use one of {', '.join(self._names)}"),
                )
