"""A network that can be worked out on paper: who is within a range gets every packet after the same delay."""

import heapq
import math
from collections.abc import Mapping, Sequence

from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State


class Disc:
    """Links with a hard range limit and a constant delay.

    Args:
        range_m: How far a packet goes; its fate is decided when it enters the network.
        delay_ns: How long it takes.
        extrapolates: See `NetworkFederate.advance`; else agents stand where they are at a window's begin.
    """

    def __init__(self, range_m: float, delay_ns: int, *, extrapolates: bool = False) -> None:
        self.extrapolates = extrapolates
        self._range_m = range_m
        self._delay_ns = delay_ns
        self._under_way: list[tuple[int, int, str]] = []

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """See `NetworkFederate.advance`."""
        drops = []
        for packet in packets:
            now = states.at(packet.enters_ns) if isinstance(states, DeadReckoned) else states
            ends = (now[name].position_m for name in (packet.source, packet.destination))
            if math.dist(*ends) > self._range_m:
                drops.append(Drop(packet.packet_id, "out of range"))
            else:
                arrival = packet.enters_ns + self._delay_ns, packet.packet_id, packet.destination
                heapq.heappush(self._under_way, arrival)
        arrivals = []
        while self._under_way and self._under_way[0][0] <= to_ns:
            at_ns, packet_id, receiver = heapq.heappop(self._under_way)
            arrivals.append(Arrival(packet_id, receiver, at_ns))
        return arrivals, drops

    def next_event_ns(self) -> int | None:
        """See `NetworkFederate.next_event_ns`."""
        return self._under_way[0][0] if self._under_way else None
