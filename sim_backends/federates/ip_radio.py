"""The radio for built-in transports whose IP packets a network federate carries."""

from collections.abc import Callable, Mapping, Sequence, Set

from fieldkit.core.model import LinkSample, Vector
from sim_backends.federates.protocols import FederateError, NetworkFederate, seconds_text
from sim_backends.federates.records import ArrivalDelay
from sim_backends.network.bare_ip import BROADCAST, UNICAST, broadcast_flow
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Arrival, Packet
from sim_backends.radio.core.links import (
    PACKET,
    PROPAGATION_NS,
    QUEUING_NS,
    TRANSMISSION_NS,
    Delay,
    Delivery,
    LinkCounters,
    LossLog,
    Pair,
)
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.mac.channel import Emitter
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.world.motion import Attitude, State


class IpRadio:
    """The radio model of a `RadioNetwork` whose packets are carried by a network federate.

    The federate advances from one of its events to the next, because hosts answer packets at the time of their
    arrival. The federate simulates radios, the relay, and the faults of radios.

    Args:
        federate: A network with the transports `ip` and `ip-broadcast`, which announces its next event.
        names: The stations.
    """

    uses_attitudes = False

    def __init__(self, federate: NetworkFederate, names: Sequence[str]) -> None:
        self._federate = federate
        self._names = tuple(names)
        self._entering_packets: list[Packet] = []
        self._in_flight: dict[int, tuple[Fragment, str]] = {}  # fragment and receiver, by packet id
        self._last_packet_id = 0
        self._broadcasts = 0
        self._states: dict[str, State] = {}
        self._stations_off: Set[str] = frozenset()
        self._parts: dict[int, ArrivalDelay] = {}  # parts of the delay, by packet id
        self._log_loss: LossLog | None = None
        log_delays = getattr(federate, "log_arrival_delays", None)
        if log_delays is not None:
            log_delays(self._log_delay)

    def place(
        self,
        now_ns: int,  # noqa: ARG002 (see RadioModel)
        positions_m: Mapping[str, Vector],
        relay: str | None,  # noqa: ARG002
        velocities_m_s: Mapping[str, Vector] | None = None,  # noqa: ARG002
        attitudes: Mapping[str, Attitude] | None = None,  # noqa: ARG002
    ) -> None:
        """Implement `RadioModel.place`."""
        self._states = {name: State(position_m) for name, position_m in positions_m.items()}

    def send(
        self,
        now_ns: int,
        source: str,
        payload: Fragment,
        size_bytes: int,
        destination: str | None,
        *,
        packet: PacketIdentity | None = None,
        before: Delay = 0,  # noqa: ARG002 (see RadioModel)
        dscp: int = 0,  # noqa: ARG002
    ) -> None:
        """Implement `RadioModel.send`; the federate does not receive the DSCP."""
        if destination is not None:
            receivers, protocol, identity = [destination], UNICAST, packet or payload.identity
        else:
            receivers, protocol = [name for name in self._names if name != source], BROADCAST
            identity = broadcast_flow(source), self._broadcasts
            self._broadcasts += 1
        for receiver in receivers:
            self._last_packet_id += 1
            self._in_flight[self._last_packet_id] = payload, receiver
            self._entering_packets.append(
                Packet(self._last_packet_id, source, receiver, size_bytes, identity, now_ns, now_ns, protocol)
            )

    def next_event_ns(self) -> int | None:
        """Implement `RadioModel.next_event_ns`."""
        return self._entering_packets[0].enters_ns if self._entering_packets else self._federate.next_event_ns()

    def deliveries(self, now_ns: int) -> list[Delivery[Fragment]]:
        """Implement `RadioModel.deliveries`.

        Raises:
            FederateError: The federate failed, or its next event is not after `now_ns`.
        """
        event_ns = self.next_event_ns()
        if event_ns is None or event_ns > now_ns:
            return []
        entering_packets, self._entering_packets = self._entering_packets, []
        present_states = {name: state for name, state in self._states.items() if name not in self._stations_off}
        arrivals, drops = self._federate.advance(now_ns, entering_packets, present_states)
        next_ns = self._federate.next_event_ns()
        if next_ns is not None and next_ns <= now_ns:
            raise FederateError(
                f"network, requested to advance to {seconds_text(now_ns)}, announced {seconds_text(next_ns)} as the "
                "time of its next event"
            )
        for drop in drops:
            fragment, host = self._in_flight.pop(drop.packet_id)
            if self._log_loss is not None:
                self._log_loss(now_ns, fragment, host, drop.reason)
        return [self._delivery(arrival) for arrival in arrivals]

    def counters(self) -> dict[Pair, LinkCounters]:
        """Implement `RadioModel.counters`; the federate reports no counters."""
        return {}

    def use_meter(self) -> None:
        """Implement `RadioModel.use_meter`; nothing to do, because the federate measures the use of its channel."""

    def sample(self, now_ns: int, utc_ns: int) -> dict[str, LinkSample]:  # noqa: ARG002 (see RadioModel)
        """Implement `RadioModel.sample`; samples are requested directly from the federate."""
        return {}

    def log_losses(self, log: LossLog | None) -> None:
        """Implement `RadioModel.log_losses`."""
        self._log_loss = log

    def disturb(self, now_ns: int, off: Set[str], cut: Set[Pair]) -> None:  # noqa: ARG002 (see RadioModel)
        """Implement `RadioModel.disturb`; stations whose radios are off have no state."""
        self._stations_off = off

    def jam(self, now_ns: int, emitters: Sequence[Emitter]) -> None:
        """Implement `RadioModel.jam`; nothing to do, because the federate simulates the scenario's jammers."""

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Implement `RadioModel.log_attempts`; the federate reports no attempts."""

    def _log_delay(self, arrival: Arrival, parts: ArrivalDelay) -> None:
        self._parts[arrival.packet_id] = parts

    def _delivery(self, arrival: Arrival) -> Delivery[Fragment]:
        fragment, host = self._in_flight.pop(arrival.packet_id)
        return arrival.at_ns, host, fragment, fragment.packet.source, self._delay(arrival)

    def _delay(self, arrival: Arrival) -> Delay:
        parts = self._parts.pop(arrival.packet_id, None)
        if parts is None:
            return PACKET
        queuing_ns, transmission_ns, propagation_ns = parts
        times = QUEUING_NS * queuing_ns + TRANSMISSION_NS * transmission_ns + PROPAGATION_NS * propagation_ns
        return PACKET + times
