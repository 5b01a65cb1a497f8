"""Tracks each packet until its delivery or drop, and computes errors of the positions that the network assumed."""

import math
from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any, Final

from fieldkit.core.model import Vector
from sim_backends.cosim.agents import AgentAbsence, SentDatagram
from sim_backends.cosim.federates import FederateError, advance_text, seconds_text
from sim_backends.cosim.run_record import Fate
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.world.dead_reckoning import DeadReckoned, extrapolate
from sim_backends.world.motion import STILL, State

ABSENT: Final = "agent absent"
"""Reason of a drop: source or destination had not appeared yet, or disappeared before the packet arrived."""
_CORRECT_NETWORK: Final = "correct the network federate; fieldkit cosim conform checks its answers"


def transmitters(network: object) -> tuple[str, ...]:
    """Return the agents that forward or interfere in a network, in addition to the senders and receivers.

    They are the value of the network's optional attribute `transmitters`.
    """
    names: Iterable[str] = getattr(network, "transmitters", ())
    return tuple(sorted(names))


def fixed_emitters_m(network: object) -> tuple[Vector, ...]:
    """Return the positions of sources of interference that are not agents, an optional attribute of the network."""
    return tuple(getattr(network, "fixed_emitters_m", ()))


def position_error_m(fate: Fate) -> float:
    """Return the largest error, in metres, of the relative positions that the network assumed for a packet.

    The error includes at least the positions of sender and receiver, at the time of sending.
    """
    if fate.position_error_m is not None:
        return fate.position_error_m
    return _max_distance_m(_offsets_m(fate.assumed_states, fate.true_states))


def max_position_error_m(
    assumed_states: Mapping[str, State],
    true_states: Sequence[State],
    names: Collection[str],
    *,
    has_fixed_emitters: bool,
) -> float:
    """Return the largest error, over all pairs of agents, of the relative position that the network assumes.

    Args:
        assumed_states: States of the agents that the network assumes.
        true_states: True states of the agents in `names`, in the same order.
        names: The agents to include.
        has_fixed_emitters: True to also include the pairs of an agent and a point that never moves.
    """
    offsets_m = _offsets_m([assumed_states[name] for name in names], true_states)
    return _max_distance_m([*offsets_m, STILL] if has_fixed_emitters else offsets_m)


def _offsets_m(assumed_states: Iterable[State], true_states: Iterable[State]) -> list[Vector]:
    """Return the error vector of each assumed position."""
    offsets_m = []
    for assumed_state, true_state in zip(assumed_states, true_states, strict=True):
        (e, n, u), (true_e, true_n, true_u) = assumed_state.position_m, true_state.position_m
        offsets_m.append((e - true_e, n - true_n, u - true_u))
    return offsets_m


def _max_distance_m(offsets_m: Sequence[Vector]) -> float:
    return max((math.dist(first, second) for first, second in combinations(offsets_m, 2)), default=0.0)


def _completed(
    assumed_states: Mapping[str, State], true_states: Mapping[str, State], absences: Mapping[str, AgentAbsence]
) -> tuple[dict[str, State], dict[str, State]]:
    """Return assumed and true states of all agents, also of those that are absent.

    A state that is missing in one mapping is replaced by the agent's last state, or by the state in the other
    mapping.
    """
    last_states = {name: absence.state for name, absence in absences.items()}
    return {**true_states, **last_states, **assumed_states}, {**assumed_states, **last_states, **true_states}


class PacketLedger:
    """Tracks each packet from its entry to its arrival or drop.

    A report of the network that cannot be true raises a `FederateError`.

    Args:
        fates: The ledger adds the fate of every packet to this mapping, by flow and number.
        step_ns: The physics step.
        measured_agents: Agents that the position error of every packet includes, in addition to its sender and
            receiver.
        has_fixed_emitters: True if the position error includes a point that never moves.
    """

    def __init__(
        self,
        fates: dict[PacketIdentity, Fate],
        step_ns: int,
        measured_agents: Iterable[str] = (),
        *,
        has_fixed_emitters: bool = False,
    ) -> None:
        self._fates = fates
        self._step_ns = step_ns
        self._measured_agents = frozenset(measured_agents)
        self._has_fixed_emitters = has_fixed_emitters
        self._under_way: dict[int, tuple[Fate, Any]] = {}
        self._withdrawn_ids: set[int] = set()
        self._packet_count = 0

    def enter(
        self,
        sent_datagram: SentDatagram,
        enters_ns: int,
        assumed_states: Mapping[str, State],
        absences: Mapping[str, AgentAbsence] | None = None,
    ) -> Fate:
        """Record a datagram as a packet that enters the network, and return its fate.

        If its source or destination is absent, the packet is dropped.

        Args:
            sent_datagram: The datagram, as its program sent it.
            enters_ns: Time when it enters the network.
            assumed_states: States that the network assumes during the window, or at its beginning (`DeadReckoned`).
            absences: The agents that are absent at the end of the window; None if all have always been present.

        Raises:
            FederateError: The destination is not an agent, or the flow already has a packet with this number.
        """
        at_ns, source, datagram, true_states = sent_datagram
        destination = datagram.destination
        if isinstance(assumed_states, DeadReckoned):
            assumed_states = assumed_states.at(enters_ns)
        is_dropped = False
        if absences is not None:
            is_dropped = destination not in true_states or any(
                name in absences and absences[name].since_ns <= enters_ns for name in (source, destination)
            )
            assumed_states, true_states = _completed(assumed_states, true_states, absences)
        try:
            assumed_ends = assumed_states[source], assumed_states[destination]
        except KeyError:
            raise FederateError(
                f"the program of {source} sent to {destination}, which is not an agent",
                remedy="correct the destination in the program",
            ) from None
        identity = datagram.flow, datagram.number
        if identity in self._fates:
            raise FederateError(
                f"the program of {source} sent two packets of flow {datagram.flow} with the number {datagram.number}",
                remedy="correct the program: each packet of a flow needs a different number",
            )
        self._packet_count += 1
        packet = Packet(
            self._packet_count,
            source,
            destination,
            datagram.size_bytes,
            identity,
            at_ns,
            enters_ns,
            datagram.protocol,
        )
        fate = self._fate(packet, assumed_ends, assumed_states, true_states)
        self._fates[identity] = fate
        if is_dropped:
            fate.reason = ABSENT
        else:
            self._under_way[self._packet_count] = fate, datagram.payload
        return fate

    def _fate(
        self,
        packet: Packet,
        assumed_ends: tuple[State, State],
        assumed_states: Mapping[str, State],
        true_states: Mapping[str, State],
    ) -> Fate:
        """Return the fate of a packet, with the true states of its source and destination when it was sent."""
        since_step_s = packet.sent_ns % self._step_ns / 1e9
        ends = true_states[packet.source], true_states[packet.destination]
        if since_step_s:
            ends = extrapolate(ends[0], since_step_s), extrapolate(ends[1], since_step_s)
        fate = Fate(packet, assumed_ends, ends)
        if self._measured_agents or self._has_fixed_emitters:
            names = self._measured_agents | {packet.source, packet.destination}
            states = [extrapolate(true_states[name], since_step_s) for name in names]
            fate.position_error_m = max_position_error_m(
                assumed_states, states, names, has_fixed_emitters=self._has_fixed_emitters
            )
        return fate

    def withdraw(self, names: Container[str]) -> list[Fate]:
        """Drop all packets under way from or to these agents, and return their fates.

        The network is not notified, so it may still report these packets later (`discard_withdrawn`).
        """
        packet_ids = [
            packet_id
            for packet_id, (fate, _) in self._under_way.items()
            if fate.packet.source in names or fate.packet.destination in names
        ]
        self._withdrawn_ids.update(packet_ids)
        fates = [self._under_way.pop(packet_id)[0] for packet_id in packet_ids]
        for fate in fates:
            fate.reason = ABSENT
        return fates

    def discard_withdrawn(self, packet_id: int) -> bool:
        """Return True if a packet was withdrawn. The ledger then deletes its number.

        The number is not needed again, because the network reports each packet only once.
        """
        if packet_id not in self._withdrawn_ids:
            return False
        self._withdrawn_ids.remove(packet_id)
        return True

    def arrive(self, arrival: Arrival, begin_ns: int, last_ns: int) -> tuple[Fate, Any]:
        """Record an arrival in a window, and return the packet's fate and payload.

        Raises:
            FederateError: The packet is not under way, or the arrival is at another agent, before the packet entered
                the network, or outside the window.
        """
        fate, payload = self._end(arrival.packet_id)
        packet = fate.packet
        if arrival.receiver != packet.destination:
            raise FederateError(
                f"the network delivered packet {packet.packet_id} for {packet.destination} to {arrival.receiver}",
                remedy=_CORRECT_NETWORK,
            )
        if not max(begin_ns, packet.enters_ns) <= arrival.at_ns <= last_ns:
            raise FederateError(
                f"the network, requested to {advance_text(begin_ns, last_ns)}, "
                f"delivered packet {packet.packet_id}, which entered at {seconds_text(packet.enters_ns)}, at "
                f"{seconds_text(arrival.at_ns)}",
                remedy=_CORRECT_NETWORK,
            )
        fate.arrived_ns = arrival.at_ns
        return fate, payload

    def drop(self, drop: Drop) -> Fate:
        """Record a packet that never arrives, and return its fate.

        Raises:
            FederateError: The packet is not under way.
        """
        fate, _ = self._end(drop.packet_id)
        fate.reason = drop.reason or "dropped"
        return fate

    def _end(self, packet_id: int) -> tuple[Fate, Any]:
        """Remove a packet from the packets under way, and return its fate and payload."""
        try:
            return self._under_way.pop(packet_id)
        except KeyError:
            explanation = (
                "which was reported before" if 0 < packet_id <= self._packet_count else "which never entered it"
            )
            raise FederateError(
                f"the network reported the fate of packet {packet_id}, {explanation}", remedy=_CORRECT_NETWORK
            ) from None
