"""The network of the co-simulation: transports over the internet protocol over a radio, in exact order of time."""

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
from sim_backends.network.wire import IpPacket, Transport, Wire
from sim_backends.radio.jamming import Emitter
from sim_backends.radio.losses import RADIO_OFF
from sim_backends.radio.model import RadioModel
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State

TransportFactory = Callable[[Wire], Transport]

IpLog = Callable[[int, str, Fragment], None]
"""Is called with when an IP packet, or a fragment, was sent by a host or arrived at it, the host, and the packet."""

UDP_ONLY: Final[Mapping[str, TransportFactory]] = MappingProxyType({"udp": Udp})


class RadioNetwork:
    """Carries packets of programs by transports, over the internet protocol and a radio model.

    Everything happens in order of time. At the same nanosecond the radio's own events come first, then disturbances
    begin and end, then come timers of transports in the order in which they were set, then packets that enter, in the
    order in which they are given; what one of these brings about at once happens before the next.

    The radio is told where stations are when something happens, not at every window: what a link does then depends
    on nothing that was told before. It is not told how they move: stations stand, for the radio, where the
    coordinator said that they are, or move on by whole steps where it said so by dead reckoning, so that the policy
    alone decides how wrong that is.

    `Transport.lost` is called for packets to one destination only: of a broadcast each host may miss its own.

    Args:
        radio: The radio model.
        names: The stations.
        transports: What makes each transport, by the name that packets have it by.
        disturbances: What goes wrong.
        relay: Whose access point relays between the others; None for direct links.

    Attributes:
        now_ns: See `Wire`.
        extrapolates: See `NetworkFederate.advance`.
        transmitters: Stations that forward or interfere, whatever is sent: the relay, and who carries a jammer.
        fixed_emitters_m: Places of jammers that nobody carries.

    Raises:
        ConfigurationError: A disturbance or the relay names a station that there is not.
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
        jammers = [one for one in disturbances if isinstance(one, Jammer)]
        self.transmitters = frozenset({relay or "", *(one.agent for one in jammers)} - {""})
        self.fixed_emitters_m = tuple(one.place_m for one in jammers if one.place_m is not None)
        self._changes_ns = changes_ns(disturbances)[::-1]
        self._off: set[str] = set()
        self._jammers: dict[str, Jammer] = {}
        self._known: Mapping[str, State] = {}
        self._placed: Mapping[str, State] | None = None
        self._timers: list[tuple[int, int, str | None, Callable[[], None]]] = []
        # What is to be called on hosts that are off, once they are on again.
        self._asleep: list[tuple[str, Callable[[], None]]] = []
        self._timers_set = 0
        self._ip_ids = dict.fromkeys(names, 0)
        self._log_ip: IpLog | None = None
        self._reassembly = ip.Reassembly(self._tell_lost)
        self._open: dict[int, Packet] = {}
        self._arrivals: list[Arrival] = []
        self._drops: list[Drop] = []
        self._transports = {name: make(self) for name, make in transports.items()}
        radio.log_losses(self._lose)

    def log_ip(self, log: IpLog | None) -> None:
        """Hand `log` every IP packet that a host sends or gets from now on, or nobody."""
        self._log_ip = log

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has, which is all but the log: what happens in a copy did not happen."""
        return self.__dict__ | {"_log_ip": None}

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """See `NetworkFederate.advance`.

        Raises:
            ConfigurationError: A packet names a transport that there is not, or is too long for it.
        """
        self._known = states
        for packet in packets:
            self._run(packet.enters_ns)
            self._place(packet.enters_ns)
            self.now_ns = packet.enters_ns
            self._open[packet.packet_id] = packet
            self._transport(packet.protocol).send(packet)
            self._collect()
        self._run(to_ns)
        self.now_ns = max(self.now_ns, to_ns)
        arrivals, drops = self._arrivals, self._drops
        self._arrivals, self._drops = [], []
        return arrivals, drops

    def next_event_ns(self) -> int | None:
        """See `NetworkFederate.next_event_ns`."""
        at_ns = self._radio.next_event_ns()
        if self._timers and (at_ns is None or self._timers[0][0] < at_ns):
            at_ns = self._timers[0][0]
        if self._changes_ns and (at_ns is None or self._changes_ns[-1] < at_ns):
            at_ns = self._changes_ns[-1]
        return at_ns

    def transmit(self, packet: IpPacket) -> None:
        """See `Wire.transmit`. What a host sends to itself arrives at once, also where its radio is off."""
        now_ns, source, destination = self.now_ns, packet.source, packet.destination
        ip_id = self._ip_ids[source]
        self._ip_ids[source] = ip_id + 1
        for fragment in ip.fragments(packet, ip_id):
            if self._log_ip is not None:
                self._log_ip(now_ns, source, fragment)
            if destination == source:
                self._plan(now_ns, None, partial(self._receive, source, fragment))
            elif source in self._off:
                for name in self._names if destination is None else (destination,):
                    if name != source:
                        self._reassembly.missing(name, fragment, RADIO_OFF)
            else:
                self._radio.send(now_ns, source, fragment, fragment.size_bytes, destination, packet=fragment.identity)

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """See `Wire.at`.

        Raises:
            ValueError: That has passed.
        """
        if at_ns < self.now_ns:
            raise ValueError(f"a timer for {at_ns} ns was set at {self.now_ns} ns")
        self._plan(at_ns, host, call)

    def deliver(self, packet_id: int) -> None:
        """See `Wire.deliver`."""
        packet = self._open.pop(packet_id, None)
        if packet is not None:
            self._arrivals.append(Arrival(packet_id, packet.destination, self.now_ns))

    def drop(self, packet_id: int, reason: str) -> None:
        """See `Wire.drop`."""
        if self._open.pop(packet_id, None) is not None:
            self._drops.append(Drop(packet_id, reason))

    def _run(self, to_ns: int) -> None:
        """Let everything happen up to `to_ns`, one event after the other."""
        while (at_ns := self.next_event_ns()) is not None and at_ns <= to_ns:
            self._place(at_ns)
            self.now_ns = at_ns
            if self._radio.next_event_ns() != at_ns:
                if self._changes_ns and self._changes_ns[-1] == at_ns:
                    self._changes_ns.pop()
                    self._disturb()
                else:
                    self._ring()
            self._collect()

    def _plan(self, at_ns: int, host: str | None, call: Callable[[], None]) -> None:
        """Call `call` at `at_ns`, on a host that has to be on, or on none."""
        self._timers_set += 1
        heapq.heappush(self._timers, (at_ns, self._timers_set, host, call))

    def _ring(self) -> None:
        """Let the next timer ring, unless its host is off."""
        _, _, host, call = heapq.heappop(self._timers)
        if host is not None and host in self._off:
            self._asleep.append((host, call))
        else:
            call()

    def _place(self, at_ns: int) -> None:
        """Tell the radio where the stations are at `at_ns`, when something happens next, if that changed."""
        states = self._known.at(at_ns) if isinstance(self._known, DeadReckoned) else self._known
        if states is self._placed:
            return
        self._placed = states
        self._radio.place(self.now_ns, {name: states[name].position_m for name in self._names}, self._relay)
        if self._jammers:
            self._jam()

    def _collect(self) -> None:
        """Let hosts have what the radio delivers now, and what that brings about at once."""
        while arrived := self._radio.deliveries(self.now_ns):
            for _, host, fragment, _, _ in arrived:
                self._receive(host, fragment)

    def _receive(self, host: str, fragment: Fragment) -> None:
        if host in self._off and host != fragment.packet.source:
            self._reassembly.missing(host, fragment, RADIO_OFF)
            return
        if self._log_ip is not None:
            self._log_ip(self.now_ns, host, fragment)
        if self._reassembly.arrived(self.now_ns, host, fragment):
            self._transports[fragment.packet.transport].receive(host, fragment.packet)

    def _lose(self, at_ns: int, fragment: Fragment, host: str, reason: str) -> None:  # noqa: ARG002 (see LossLog)
        self._reassembly.missing(host, fragment, reason)

    def _tell_lost(self, packet: IpPacket, host: str, reason: str) -> None:
        if packet.destination == host:
            self._transports[packet.transport].lost(packet, reason)

    def _disturb(self) -> None:
        """Let begin what begins now, and end what ends now."""
        now_on = active(self._disturbances, self.now_ns)
        off = {one.name for one in now_on if isinstance(one, NodeLoss)}
        cut = {(one.one, one.other) for one in now_on if isinstance(one, LinkCut)}
        newly_off, self._off = off - self._off, off
        self._radio.disturb(self.now_ns, off, cut)
        for host in sorted(newly_off):
            self._reassembly.forget(host, RADIO_OFF)
        asleep, self._asleep = self._asleep, []
        for host, call in asleep:
            self._plan(self.now_ns, host, call)
        jammers = {f"jammer {one}": one for one in now_on if isinstance(one, Jammer)}
        if jammers or self._jammers:
            self._jammers = jammers
            self._jam()

    def _jam(self) -> None:
        emitters = [Emitter(name, self._where_m(one), one.power_dbm) for name, one in self._jammers.items()]
        self._radio.jam(self.now_ns, emitters)

    def _where_m(self, jammer: Jammer) -> Vector:
        known = self._known if self._placed is None else self._placed
        return known[jammer.agent].position_m if jammer.place_m is None else jammer.place_m

    def _transport(self, name: str) -> Transport:
        if name not in self._transports:
            raise ConfigurationError(
                f"there is no transport {name!r}",
                remedy=did_you_mean(name, self._transports, f"take one of {', '.join(self._transports)}"),
            )
        return self._transports[name]

    def _check_names(self) -> None:
        named = [] if self._relay is None else [self._relay]
        for one in self._disturbances:
            if isinstance(one, NodeLoss):
                named.append(one.name)
            elif isinstance(one, LinkCut):
                named += [one.one, one.other]
        for name in named:
            if name not in self._names:
                raise ConfigurationError(
                    f"there is no station {name!r}",
                    remedy=did_you_mean(name, self._names, f"take one of {', '.join(self._names)}"),
                )
