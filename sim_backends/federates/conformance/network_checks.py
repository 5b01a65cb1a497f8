"""Conformance checks of a network federate: times, fates of packets, window borders, reasons, determinism, forks."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

from sim_backends.federates.conformance.probe import CheckError, FederateProbe, NotDeclaredError, Target
from sim_backends.federates.exchanges import AdvanceNetwork, NetworkOutcomes
from sim_backends.federates.frames import MessageKind
from sim_backends.federates.handshake import NO_EVENT, FederateCapability
from sim_backends.network.packets import Arrival, Packet
from sim_backends.world.motion import State

_MS: Final = 1_000_000
_WINDOW_NS: Final = 1_100_000
"""Length of a window in most checks."""
_END_NS: Final = 5_000 * _MS
"""Time until which the fate of every packet must be decided."""
_FAR_M: Final = 1e6
"""Distance of an agent that is out of range of any radio."""
_SIZE_BYTES: Final = 200
"""Size of a packet."""
_MAX_EVENTS: Final = 500
"""Largest number of announced events that are checked."""
_SEEDS: Final = 4
"""Number of seeds that are compared."""
_DISTANCES_M: Final = (10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0)
"""Distances at which packets are sent, because a network may lose packets at only some of the distances."""
_GROUP_SIZE: Final = 32
"""Number of packets at each distance."""
_SPACING_NS: Final = 20 * _MS
"""Time between two packets; each packet should arrive before the next one enters."""
_RANDOM_CHANGES: Final = 4
"""Minimum number of changes between arrivals and losses if losses are random. A network that
only changes a route has fewer."""


def _states(probe: FederateProbe) -> dict[str, State]:
    return {agent.name: State(agent.start.position_m) for agent in probe.hello.agents}


def _packets(probe: FederateProbe, times_ns: Sequence[int]) -> list[Packet]:
    """Return packets between the first two agents, alternately in both directions."""
    ends = [agent.name for agent in probe.hello.agents[:2]]
    if len(ends) < 2:
        raise NotDeclaredError("the scenario has only one agent")
    protocol = (probe.welcome.transports or ("udp",))[0]
    packets = []
    for number, at_ns in enumerate(times_ns):
        source, destination = ends[::-1] if number % 2 else ends
        packets.append(
            Packet(number + 1, source, destination, _SIZE_BYTES, ("check", number), at_ns, at_ns, protocol)
        )
    return packets


def _times_ns() -> list[int]:
    """Return the times of the packets: the start of every fourth window, 1 ns later, and 0.5 ms later."""
    return [number * _WINDOW_NS + offset_ns for number in range(0, 60, 4) for offset_ns in (0, 1, 500_000)]


class _FateAccount:
    """Records the fates of packets, and checks the reports of the network.

    Attributes:
        arrivals: All arrivals so far, in the order of the reports.
        reasons: Reason of each drop, by the number of the packet.
    """

    def __init__(self, probe: FederateProbe) -> None:
        self._probe = probe
        self._packets: dict[int, Packet] = {}
        self._decided_ids: set[int] = set()
        self._next_event_ns = probe.welcome.next_event_ns
        self.arrivals: list[Arrival] = []
        self.reasons: dict[int, str] = {}

    def advance(
        self, to_ns: int, states: Mapping[str, State], packets: Sequence[Packet] = (), *, copy: int = 0
    ) -> NetworkOutcomes:
        """Advance the network, and check its answer."""
        from_ns = self._probe.last_ns
        outcomes = self._probe.advance_network(to_ns, states, packets, copy=copy)
        self._packets |= {packet.packet_id: packet for packet in packets}
        if outcomes.at_ns != to_ns:
            raise CheckError(f"it was requested to advance to {to_ns} ns, but advanced to {outcomes.at_ns} ns")
        if self._probe.has(FederateCapability.NEXT_EVENT):
            self._check_next_event(outcomes, to_ns, has_packets=bool(packets))
        for arrival in outcomes.arrivals:
            self._check_arrival(arrival, from_ns, to_ns)
        for drop in outcomes.drops:
            self._decide(drop.packet_id)
            if not drop.reason:
                raise CheckError(f"packet {drop.packet_id} was dropped without a reason")
            self.reasons[drop.packet_id] = drop.reason
        times_ns = [arrival.at_ns for arrival in outcomes.arrivals]
        if times_ns != sorted(times_ns):
            raise CheckError(f"the arrivals are not in order of time: {times_ns}")
        self.arrivals += outcomes.arrivals
        return outcomes

    def undecided(self) -> list[int]:
        """Return the numbers of packets that neither arrived nor were dropped."""
        return sorted(self._packets.keys() - self._decided_ids)

    def _decide(self, packet_id: int) -> None:
        if packet_id not in self._packets:
            raise CheckError(f"the fate of packet {packet_id} was reported, but it was not sent to the network")
        if packet_id in self._decided_ids:
            raise CheckError(f"the fate of packet {packet_id} was reported twice")
        self._decided_ids.add(packet_id)

    def _check_arrival(self, arrival: Arrival, from_ns: int, to_ns: int) -> None:
        self._decide(arrival.packet_id)
        packet = self._packets[arrival.packet_id]
        if arrival.receiver != packet.destination:
            raise CheckError(f"packet {packet.packet_id} for {packet.destination} arrived at {arrival.receiver}")
        earliest_ns = max(packet.enters_ns, from_ns)
        if not earliest_ns <= arrival.at_ns <= to_ns:
            raise CheckError(
                f"packet {packet.packet_id} arrived at {arrival.at_ns} ns, not between {earliest_ns} and {to_ns} ns"
            )

    def _check_next_event(self, outcomes: NetworkOutcomes, to_ns: int, *, has_packets: bool) -> None:
        """Check that nothing happened before the announced next event, and that the new one is in the future."""
        announced_ns, self._next_event_ns = self._next_event_ns, outcomes.next_event_ns
        if outcomes.next_event_ns != NO_EVENT and outcomes.next_event_ns <= to_ns:
            raise CheckError(f"after advancing to {to_ns} ns, its next event is at {outcomes.next_event_ns} ns")
        if has_packets:
            return
        for arrival in outcomes.arrivals:
            if announced_ns == NO_EVENT or arrival.at_ns < announced_ns:
                raise CheckError(
                    f"packet {arrival.packet_id} arrived at {arrival.at_ns} ns, before the announced next event "
                    f"({announced_ns} ns)"
                )
        for drop in outcomes.drops:
            if announced_ns == NO_EVENT or to_ns < announced_ns:
                raise CheckError(
                    f"packet {drop.packet_id} was dropped by {to_ns} ns, before the announced next event "
                    f"({announced_ns} ns)"
                )


def _run(probe: FederateProbe, window_ns: int, until_ns: int = _END_NS) -> _FateAccount:
    """Send packets in windows of length `window_ns`; after the last packet, windows are 100 times as long."""
    account, states = _FateAccount(probe), _states(probe)
    remaining_packets = _packets(probe, _times_ns())
    to_ns = -1
    while to_ns < until_ns:
        to_ns += window_ns if remaining_packets else 100 * window_ns
        entering_packets = [packet for packet in remaining_packets if packet.enters_ns <= to_ns]
        remaining_packets = remaining_packets[len(entering_packets) :]
        account.advance(to_ns, states, entering_packets)
    return account


def check_first_request(target: Target) -> None:
    """A first request for time -1, which is sent if the first window has length 0, is answered."""
    probe = target.open()
    outcomes = probe.advance_network(-1, _states(probe))
    if outcomes.at_ns != -1 or outcomes.arrivals or outcomes.drops:
        raise CheckError("the first request for -1 ns was not answered with this time and without packets")


def check_exactly_once(target: Target) -> None:
    """Each packet arrives or is dropped exactly once, in its window, in order of time; drops have reasons."""
    undecided = _run(target.open(), _WINDOW_NS).undecided()
    if undecided:
        raise CheckError(
            f"number of packets that neither arrived nor were dropped after {_END_NS / 1e9:g} s: {len(undecided)}"
        )


def check_next_event(target: Target) -> None:
    """Nothing arrives or is dropped before the announced next event; the announced time may be too early."""
    probe = target.open()
    probe.require(FederateCapability.NEXT_EVENT)
    account, states = _FateAccount(probe), _states(probe)
    outcomes = account.advance(3 * _MS, states, _packets(probe, (_MS, _MS + 1, 3 * _MS)))
    for _ in range(_MAX_EVENTS):
        event_ns = outcomes.next_event_ns
        if not NO_EVENT < event_ns <= _END_NS:
            break
        account.advance(event_ns - 1, states)
        outcomes = account.advance(event_ns, states)
    if outcomes.next_event_ns == NO_EVENT and (undecided := account.undecided()):
        raise CheckError(f"it has no next event, but packets {undecided} neither arrived nor were dropped")


def check_window_borders(target: Target) -> None:
    """A packet may enter at either end of a window, and does not arrive before it has entered."""
    probe = target.open()
    account, states = _FateAccount(probe), _states(probe)
    first, second, third = _packets(probe, (10 * _MS, 10 * _MS, 10 * _MS + 1))
    account.advance(10 * _MS, states, [first])
    account.advance(10 * _MS + 1, states, [second, third])
    account.advance(10 * _MS + 1, states)
    account.advance(_END_NS, states)
    if undecided := account.undecided():
        raise CheckError(f"packets {undecided} at the border of a window neither arrived nor were dropped")


def check_window_length(target: Target) -> None:
    """Agents that do not move get the same arrivals in short and in long windows."""
    arrivals = []
    for window_ns in (_WINDOW_NS, 13 * _WINDOW_NS):
        probe = target.open()
        probe.require(FederateCapability.DETERMINISTIC)
        arrivals.append(sorted(_run(probe, window_ns).arrivals, key=lambda arrival: arrival.packet_id))
    for short, long in zip(*arrivals, strict=False):
        if short != long:
            raise CheckError(f"windows of another length changed an arrival: {short} and {long}")
    if len(arrivals[0]) != len(arrivals[1]):
        raise CheckError(
            f"windows of another length changed the number of arrivals from {len(arrivals[0])} to {len(arrivals[1])}"
        )


def check_far_away(target: Target) -> None:
    """The fate of a packet to an agent that is 1,000 km away is decided, with a reason if it is dropped."""
    probe = target.open()
    account, states = _FateAccount(probe), _states(probe)
    distant_agent = probe.hello.agents[-1].name if len(probe.hello.agents) < 2 else probe.hello.agents[1].name
    states[distant_agent] = State((_FAR_M, 0.0, 1.0))
    account.advance(10 * _MS, states, _packets(probe, [5 * _MS]))
    account.advance(_END_NS, states)
    if account.undecided():
        raise CheckError("a packet to an agent that is 1,000 km away neither arrived nor was dropped")


def check_unknown_transport(target: Target) -> None:
    """A packet of a transport that is not listed is refused with an error, if transports are listed."""
    probe = target.open()
    if not probe.welcome.transports:
        raise NotDeclaredError("it lists no transports")
    (packet,) = _packets(probe, [_MS])
    protocol = "no-such-transport"
    unlisted_packet = Packet(1, packet.source, packet.destination, 1, packet.identity, _MS, _MS, protocol)
    body = AdvanceNetwork(2 * _MS, _states(probe), [unlisted_packet]).encode(probe.agents)
    probe.expect_error(
        MessageKind.ADVANCE_NETWORK,
        body,
        MessageKind.OUTCOMES,
        f"a packet of a transport that is not listed, the protocol {protocol}",
    )


def check_determinism(target: Target) -> None:
    """Equal requests give equal answers, if the federate declares this."""
    accounts = []
    for _ in range(2):
        probe = target.open()
        probe.require(FederateCapability.DETERMINISTIC)
        accounts.append(_run(probe, _WINDOW_NS))
    first, second = accounts
    if first.arrivals != second.arrivals or first.reasons != second.reasons:
        raise CheckError("equal requests gave different arrivals or drops")


def _arrivals_ns(probe: FederateProbe, every: int = 1) -> dict[int, int]:
    """Return the arrival times of packets that are sent at several distances.

    Args:
        probe: The network.
        every: n to send only every n-th packet.
    """
    account, states = _FateAccount(probe), _states(probe)
    packets = _packets(probe, [_MS + number * _SPACING_NS for number in range(len(_DISTANCES_M) * _GROUP_SIZE)])
    first, second = (agent.name for agent in probe.hello.agents[:2])
    east_m, north_m, up_m = states[first].position_m
    for group, distance_m in enumerate(_DISTANCES_M):
        states[second] = State((east_m + distance_m, north_m, up_m))
        entering_packets = packets[group * _GROUP_SIZE : (group + 1) * _GROUP_SIZE : every]
        account.advance((group + 1) * _GROUP_SIZE * _SPACING_NS, states, entering_packets)
    account.advance(2 * _END_NS, states)
    return {arrival.packet_id: arrival.at_ns for arrival in account.arrivals}


def _is_random(arrivals_ns: Mapping[int, int]) -> bool:
    """Return True if losses seem to be random.

    The fates of equal packets must differ without a periodic pattern. Packets must not contend: each one arrives
    before the next one enters.
    """
    for packet_id, at_ns in arrivals_ns.items():
        if at_ns >= _MS + packet_id * _SPACING_NS:  # when the next packet enters
            return False
    for first in range(1, len(_DISTANCES_M) * _GROUP_SIZE, _GROUP_SIZE):
        for direction in range(2):
            fates = [packet_id in arrivals_ns for packet_id in range(first + direction, first + _GROUP_SIZE, 2)]
            changes = sum(fate != other for fate, other in pairwise(fates))
            is_periodic = any(fates[period:] == fates[:-period] for period in range(1, len(fates) // 2 + 1))
            if changes >= _RANDOM_CHANGES and not is_periodic:
                return True
    return False


def check_seed(target: Target) -> None:
    """Another seed gives other random draws, if the network has any."""
    results = []
    for offset in range(_SEEDS):
        probe = target.open(replace(target.hello, seed=target.hello.seed + offset))
        probe.require(FederateCapability.DETERMINISTIC)
        results.append(_arrivals_ns(probe))
        if results[-1] != results[0]:
            return
    if _is_random(results[0]):
        raise CheckError(f"it loses packets at random, but {_SEEDS} seeds gave the same arrivals and drops")
    raise NotDeclaredError(f"{_SEEDS} seeds gave the same arrivals, and no random losses occurred")


def check_removed_packets(target: Target) -> None:
    """The fate of a packet is the same without other packets. This is a recommendation, so the check never fails."""
    results = []
    for every in (1, 2):
        probe = target.open()
        probe.require(FederateCapability.DETERMINISTIC)
        results.append(_arrivals_ns(probe, every))
    arrivals_of_all, arrivals_of_half = results
    for packet_id in range(1, len(_DISTANCES_M) * _GROUP_SIZE, 2):
        if (packet_id in arrivals_of_all) != (packet_id in arrivals_of_half):
            raise NotDeclaredError(
                f"packet {packet_id} had another fate without other packets: its draws depend on the order of "
                "packets, or on contention"
            )


def check_new_agent(target: Target) -> None:
    """The fate of a packet to an agent that has appeared is decided, if agents may appear."""
    probe = target.open()
    probe.require(FederateCapability.AGENTS_APPEAR)
    account, states = _FateAccount(probe), _states(probe)
    account.advance(_MS, states)
    first = probe.hello.agents[0].name
    states["new agent"] = states[first]
    protocol = (probe.welcome.transports or ("udp",))[0]
    packet = Packet(1, first, "new agent", _SIZE_BYTES, ("check", 0), 2 * _MS, 2 * _MS, protocol)
    account.advance(3 * _MS, states, [packet])
    account.advance(_END_NS, states)
    if account.undecided():
        raise CheckError("a packet to an agent that has appeared neither arrived nor was dropped")


def check_absent_agent(target: Target) -> None:
    """Nothing arrives at an agent without a state, if the federate declares that agents may disappear."""
    probe = target.open()
    probe.require(FederateCapability.AGENTS_DISAPPEAR)
    account, states = _FateAccount(probe), _states(probe)
    packets = _packets(probe, [2 * _MS, 3 * _MS, 4 * _MS])[::2]
    receiver = packets[0].destination
    present_states = {name: state for name, state in states.items() if name != receiver}
    account.advance(_MS, states)
    account.advance(1_000 * _MS, present_states, packets)
    if account.arrivals:
        raise CheckError(f"a packet arrived at {receiver}, which has disappeared")
    account.advance(_END_NS, states)
    if account.undecided():
        raise CheckError("a packet to an agent that has disappeared neither arrived nor was dropped")


def check_dead_reckoning(target: Target) -> None:
    """Extrapolation at a velocity of 0 changes nothing, if the federate declares that it extrapolates."""
    arrivals = []
    for reckoning_ns in (0, _MS):
        probe = target.open()
        probe.require(FederateCapability.EXTRAPOLATES)
        states = _states(probe)
        outcomes = [
            probe.advance_network(to_ns, states, packets, reckoning_ns=reckoning_ns)
            for to_ns, packets in ((10 * _MS, _packets(probe, [5 * _MS])), (_END_NS, []))
        ]
        arrivals.append([outcome.arrivals for outcome in outcomes])
    if arrivals[0] != arrivals[1]:
        raise CheckError("extrapolation at a velocity of 0 changed the arrivals")


def check_fork(target: Target) -> None:
    """A copy continues like the original, and neither changes the other."""
    probe = target.open()
    probe.require(FederateCapability.FORK)
    states = _states(probe)
    packets = _packets(probe, [number * _MS for number in range(5)])
    probe.advance_network(_MS, states, packets[:2])
    probe.fork(1)
    requests = (5 * _MS, packets[2:]), (_END_NS, packets[:0])
    copy_outcomes, original_outcomes = (
        [probe.advance_network(to_ns, states, entering_packets, copy=copy) for to_ns, entering_packets in requests]
        for copy in (1, 0)
    )
    if copy_outcomes != original_outcomes:
        raise CheckError("the copy and the original gave different answers to equal requests")
