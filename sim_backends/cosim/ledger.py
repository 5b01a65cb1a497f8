"""The ledger of a run: which packets there are, what each carries, and what became of it."""

from collections.abc import Mapping
from typing import Any

from sim_backends.cosim.agents import Sent
from sim_backends.cosim.run import Fate
from sim_backends.cosim.watchdog import FederateError, seconds
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.radio.random_streams import PacketIdentity
from sim_backends.world.motion import State


class PacketLedger:
    """Keeps the account of packets; who books what cannot be is named.

    Args:
        fates: Takes the fate of every packet that entered the network, by flow and number.
    """

    def __init__(self, fates: dict[PacketIdentity, Fate]) -> None:
        self._fates = fates
        self._under_way: dict[int, tuple[Fate, Any]] = {}
        self._packets = 0

    def packet(self, sent: Sent, enters_ns: int) -> Packet:
        """Return a datagram as the packet that the network gets at `enters_ns`."""
        datagram = sent.datagram
        self._packets += 1
        return Packet(
            self._packets,
            sent.source,
            datagram.destination,
            datagram.size_bytes,
            (datagram.flow, datagram.number),
            sent.at_ns,
            enters_ns,
            datagram.protocol,
        )

    def enter(self, sent: Sent, packet: Packet, known: Mapping[str, State]) -> Fate:
        """Book a packet that enters the network.

        Args:
            sent: How its program sent it.
            packet: The packet.
            known: Where the network takes the agents to be.

        Raises:
            FederateError: It is for nobody, or its flow has a packet of this number already.
        """
        ends = packet.source, packet.destination
        if packet.destination not in known:
            raise FederateError(f"the program of {packet.source} sent to {packet.destination}, who is no agent")
        if packet.identity in self._fates:
            flow, number = packet.identity
            raise FederateError(
                f"the program of {packet.source} sent two packets of flow {flow} with the number {number}"
            )
        fate = self._fates[packet.identity] = Fate(packet, _of(known, ends), _of(sent.states, ends))
        self._under_way[packet.packet_id] = fate, sent.datagram.payload
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


def _of(states: Mapping[str, State], ends: tuple[str, str]) -> tuple[State, State]:
    one, other = ends
    return states[one], states[other]
