"""The ledger of a run: which packets there are, what each carries, and what became of it."""

from collections.abc import Iterable, Mapping
from typing import Any

from sim_backends.cosim.agents import Sent
from sim_backends.cosim.federate_errors import FederateError, seconds
from sim_backends.cosim.geometry import largest_m
from sim_backends.cosim.run import Fate
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.radio.random_streams import PacketIdentity
from sim_backends.world.dead_reckoning import DeadReckoned, moved_on
from sim_backends.world.motion import State


class PacketLedger:
    """Keeps the account of packets; who books what cannot be is named.

    Args:
        fates: Takes the fate of every packet that entered the network, by flow and number.
        step_ns: Own step of the physics.
        measured: Agents whose places count for every packet, beside those of its sender and its receiver.
        anchored: Whether the place of something that never moves counts, too.
    """

    def __init__(
        self,
        fates: dict[PacketIdentity, Fate],
        step_ns: int,
        measured: Iterable[str] = (),
        *,
        anchored: bool = False,
    ) -> None:
        self._fates = fates
        self._step_ns = step_ns
        self._measured = frozenset(measured)
        self._anchored = anchored
        self._under_way: dict[int, tuple[Fate, Any]] = {}
        self._packets = 0

    def enter(self, sent: Sent, enters_ns: int, known: Mapping[str, State]) -> Fate:
        """Book a datagram as a packet that enters the network.

        Args:
            sent: How its program sent it.
            enters_ns: When the network gets it.
            known: Where the network takes the agents to be throughout the window, or at its begin (`DeadReckoned`).

        Raises:
            FederateError: It is for nobody, or its flow has a packet of this number already.
        """
        at_ns, source, datagram, true = sent
        destination = datagram.destination
        if isinstance(known, DeadReckoned):
            known = known.at(enters_ns)
        if destination not in known:
            raise FederateError(f"the program of {source} sent to {destination}, who is no agent")
        identity = datagram.flow, datagram.number
        if identity in self._fates:
            raise FederateError(
                f"the program of {source} sent two packets of flow {datagram.flow} with the number {datagram.number}"
            )
        self._packets += 1
        packet = Packet(
            self._packets, source, destination, datagram.size_bytes, identity, at_ns, enters_ns, datagram.protocol
        )
        held_s = at_ns % self._step_ns / 1e9
        ends = true[source], true[destination]
        if held_s:
            ends = moved_on(ends[0], held_s), moved_on(ends[1], held_s)
        fate = Fate(packet, (known[source], known[destination]), ends)
        if self._measured or self._anchored:
            names = self._measured | {source, destination}
            states = [moved_on(true[name], held_s) for name in names]
            fate.displaced_m = largest_m(known, states, names, anchored=self._anchored)
        self._fates[identity] = fate
        self._under_way[self._packets] = fate, datagram.payload
        return fate

    def arrive(self, arrival: Arrival, begin_ns: int, last_ns: int) -> tuple[Fate, Any]:
        """Book an arrival in a window; return its fate and its payload.

        Raises:
            FederateError: It is of a packet that is not under way, at somebody else, before it entered, or outside
                the window.
        """
        fate, payload = self._end(arrival.packet_id)
        packet = fate.packet
        if arrival.receiver != packet.destination:
            raise FederateError(
                f"the network delivered packet {packet.packet_id} for {packet.destination} to {arrival.receiver}"
            )
        if not max(begin_ns, packet.enters_ns) <= arrival.at_ns <= last_ns:
            raise FederateError(
                f"the network, asked to advance from {seconds(begin_ns)} to {seconds(last_ns)}, delivered packet "
                f"{packet.packet_id}, which entered at {seconds(packet.enters_ns)}, at {seconds(arrival.at_ns)}"
            )
        fate.arrived_ns = arrival.at_ns
        return fate, payload

    def drop(self, drop: Drop) -> Fate:
        """Book a packet that never arrives.

        Raises:
            FederateError: It is not under way.
        """
        fate, _ = self._end(drop.packet_id)
        fate.reason = drop.reason or "dropped"
        return fate

    def _end(self, packet_id: int) -> tuple[Fate, Any]:
        try:
            return self._under_way.pop(packet_id)
        except KeyError:
            why = "whose fate it has told already" if 0 < packet_id <= self._packets else "which it never got"
            raise FederateError(f"the network told the fate of packet {packet_id}, {why}") from None
