"""The coordinator: lets agents and network go from window to window, and carries what crosses between them.

It keeps the payload; the network sees identities, sizes and times. It records what became of every packet.
"""

import copy
import hashlib
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from sim_backends.cosim.agents import Agents, Sent
from sim_backends.cosim.federates import NetworkFederate
from sim_backends.cosim.packets import Arrival, Packet, Received
from sim_backends.cosim.policies.base import Pair, PolicyError, Situation, SyncPolicy
from sim_backends.radio.random_streams import PacketIdentity
from sim_backends.world.motion import State

_MOST_AT_ONCE: Final = 1000
_EVENT: Final = struct.Struct("<cQQ")


@dataclass(slots=True)
class Fate:
    """What became of a packet.

    Attributes:
        packet: The packet, with when it was sent and when the network got it.
        known: Where the network took source and destination to be when it got the packet.
        true: Where they were when it was sent.
        arrived_ns: When it arrived by the network's clock; None if it did not.
        counted_ns: When it arrived by the policy: its window's end, or `arrived_ns`.
        late_ns: By how much its receiver had passed that time already.
        reason: Why it never arrived; empty if it did, or is under way.
    """

    packet: Packet
    known: tuple[State, State]
    true: tuple[State, State]
    arrived_ns: int | None = None
    counted_ns: int | None = None
    late_ns: int = 0
    reason: str = ""

    @property
    def is_known(self) -> bool:
        """Whether it arrived, or never will."""
        return self.arrived_ns is not None or bool(self.reason)


@dataclass
class Run:
    """What a run recorded.

    Attributes:
        fates: Of every packet, by flow and number.
        windows_ns: The ends of all windows.
        wall_s: Wall time by part: agents, network, exchange.
        digest: Hash over every packet, arrival, drop and window, in order.
    """

    fates: dict[PacketIdentity, Fate] = field(default_factory=dict)
    windows_ns: list[int] = field(default_factory=list)
    wall_s: dict[str, float] = field(default_factory=lambda: {"agents": 0.0, "network": 0.0, "exchange": 0.0})
    digest: str = ""


class Coordinator:
    """Runs a co-simulation from time 0 on.

    Args:
        agents: Bodies and programs.
        network: Carries packets.
        policy: Says how long windows are.
        pairs: Who may send to whom.

    Attributes:
        policy: As given; another one may go on where a window ended.
        run: What was recorded so far.
    """

    def __init__(self, agents: Agents, network: NetworkFederate, policy: SyncPolicy, pairs: Sequence[Pair]) -> None:
        self._agents = agents
        self._network = network
        self.policy = policy
        self._pairs = tuple(pairs)
        self._under_way: dict[int, tuple[Fate, Any]] = {}
        self._held: list[tuple[Sent, Packet]] = []
        self._packets = 0
        self._hash = hashlib.blake2b(digest_size=16)
        self._now_ns = 0
        self._states = agents.states(0)
        self.run = Run()

    def advance(self, to_ns: int) -> Run:
        """Go on until `to_ns`; return what was recorded so far.

        Raises:
            PolicyError: The policy has no window, or one that does not end later; what was recorded is kept.
        """
        stood = 0
        while self._now_ns < to_ns:
            end_ns = self.policy.next_window(self.situation)
            end_ns = to_ns if end_ns is None else min(end_ns, to_ns)
            stood = stood + 1 if end_ns <= self._now_ns else 0
            if end_ns < self._now_ns or stood > _MOST_AT_ONCE:
                raise PolicyError(
                    f"time does not go on beyond {self._now_ns} ns", where=self.policy.name, remedy="take another one"
                )
            self._window(end_ns)
        self.run.digest = self._hash.hexdigest()
        return self.run

    def fork(self) -> "Coordinator":
        """Return a co-simulation of its own that stands where this one does; neither changes the other."""
        return copy.deepcopy(self, {id(self._hash): self._hash.copy()})

    @property
    def situation(self) -> Situation:
        """What the policy decides the next window by."""
        physics = self._agents.physics
        return Situation(
            self._now_ns,
            self._states,
            self._pairs,
            self._now_ns if self._agents.mail or self._held else self._agents.next_wake_ns(),
            self._network.next_event_ns(),
            physics.step_ns,
            physics.limits_m_s2,
        )

    def _window(self, end_ns: int) -> None:
        policy = self.policy
        # The end of a window belongs to it where the network knows the states at it.
        last_ns = end_ns if policy.knows_end else end_ns - 1
        begun_s = time.perf_counter()
        sent = self._agents.advance(self._now_ns, last_ns)
        states = self._agents.states(end_ns)
        moved_s = time.perf_counter()
        known = states if policy.knows_end else self._states
        offered = [(one, self._packet(one, end_ns if policy.holds_sends else one.at_ns)) for one in sent]
        entering, self._held = (self._held, offered) if policy.holds_sends else (self._held + offered, [])
        for one, packet in entering:
            self._enter(one, packet, known)
        exchanged_s = time.perf_counter()
        arrivals, drops = self._network.advance(last_ns, [packet for _, packet in entering], known)
        carried_s = time.perf_counter()
        for arrival in arrivals:
            self._arrive(arrival, end_ns)
        for drop in drops:
            self._log(b"d", drop.packet_id, end_ns)
            self._under_way.pop(drop.packet_id)[0].reason = drop.reason
        self._log(b"w", len(self.run.windows_ns), end_ns)
        self.run.windows_ns.append(end_ns)
        self._now_ns, self._states = end_ns, states
        wall_s = self.run.wall_s
        wall_s["agents"] += moved_s - begun_s
        wall_s["network"] += carried_s - exchanged_s
        wall_s["exchange"] += exchanged_s - moved_s + time.perf_counter() - carried_s

    def _packet(self, sent: Sent, enters_ns: int) -> Packet:
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

    def _enter(self, sent: Sent, packet: Packet, known: Mapping[str, State]) -> None:
        ends = packet.source, packet.destination
        fate = Fate(packet, _of(known, ends), _of(sent.states, ends))
        if packet.identity in self.run.fates:
            raise ValueError(f"two packets of flow {packet.identity[0]} have the number {packet.identity[1]}")
        self.run.fates[packet.identity] = fate
        self._under_way[packet.packet_id] = fate, sent.datagram.payload
        self._log(b"s", packet.packet_id, packet.enters_ns)

    def _arrive(self, arrival: Arrival, end_ns: int) -> None:
        fate, payload = self._under_way.pop(arrival.packet_id)
        fate.arrived_ns = arrival.at_ns
        fate.counted_ns = end_ns if self.policy.holds_arrivals else arrival.at_ns
        fate.late_ns = end_ns - fate.counted_ns
        self._log(b"a", arrival.packet_id, arrival.at_ns)
        packet = fate.packet
        self._agents.hand_over(packet.destination, Received(packet.source, payload, packet.sent_ns, fate.counted_ns))

    def _log(self, kind: bytes, number: int, at_ns: int) -> None:
        self._hash.update(_EVENT.pack(kind, number, at_ns))


def _of(states: Mapping[str, State], ends: tuple[str, str]) -> tuple[State, State]:
    one, other = ends
    return states[one], states[other]
