"""An analytically solvable network: every receiver within range gets each packet after the same delay."""

import heapq
import math
from collections.abc import Mapping, Sequence

from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State


class Disc:
    """Links with a hard range limit and a constant delay.

    Args:
        range_m: Maximum range; it is compared with the distance at the time when the packet enters the network.
        delay_ns: Delay of every packet.
        extrapolates: True to evaluate dead-reckoned states when a packet enters; False if agents stay at their
            positions at the start of a window.
    """

    def __init__(self, range_m: float, delay_ns: int, *, extrapolates: bool = False) -> None:
        self.extrapolates = extrapolates
        self._range_m = range_m
        self._delay_ns = delay_ns
        self._in_flight: list[tuple[int, int, str]] = []

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Implement `NetworkFederate.advance`."""
        drops = []
        for packet in packets:
            current_states = states.at(packet.enters_ns) if isinstance(states, DeadReckoned) else states
            source, destination = current_states.get(packet.source), current_states.get(packet.destination)
            if source is None or destination is None:
                drops.append(Drop(packet.packet_id, "absent"))
            elif math.dist(source.position_m, destination.position_m) > self._range_m:
                drops.append(Drop(packet.packet_id, "out of range"))
            else:
                arrival = packet.enters_ns + self._delay_ns, packet.packet_id, packet.destination
                heapq.heappush(self._in_flight, arrival)
        arrivals = []
        while self._in_flight and self._in_flight[0][0] <= to_ns:
            at_ns, packet_id, receiver = heapq.heappop(self._in_flight)
            arrivals.append(Arrival(packet_id, receiver, at_ns))
        return arrivals, drops

    def next_event_ns(self) -> int | None:
        """Implement `NetworkFederate.next_event_ns`."""
        return self._in_flight[0][0] if self._in_flight else None
