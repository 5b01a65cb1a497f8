"""The coordinator with federates whose every answer was written down beforehand, at random."""

import hashlib
import heapq
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle, islice, pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.digest import EventDigest
from sim_backends.cosim.federates import Action
from sim_backends.cosim.observer import Window, WindowObserver
from sim_backends.cosim.policies.base import Situation
from sim_backends.cosim.run import Fate, Run
from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, Received
from sim_backends.world.motion import State

NAMES = ("a", "b", "c")
END_NS = 1_000
LOST = None


class Drifting:
    """Agents that are where the time is, in metres, at whole steps."""

    def __init__(self, names: Sequence[str], step_ns: int) -> None:
        self._names = names
        self.step_ns = step_ns
        self.limits_m_s2: Mapping[str, float] = dict.fromkeys(names, 0.0)
        self.asked: list[int] = [0]

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        assert to_ns >= self.asked[-1], "asked with times that never go back"
        self.asked.append(to_ns)
        return {name: State((float(to_ns // self.step_ns * self.step_ns), 0.0, 0.0)) for name in self._names}


class Scripted:
    """Sends at given times, and answers every datagram that is no answer."""

    def __init__(self, name: str, sends: Sequence[tuple[int, str]]) -> None:
        self._name = name
        self._sends = sorted(sends)[::-1]
        self._numbers: dict[str, int] = {}
        self.heard: list[tuple[int, Received]] = []

    def next_wake_ns(self) -> int | None:
        return self._sends[-1][0] if self._sends else None

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        self.heard += [(now_ns, one) for one in received]
        to = [one.source for one in received if one.payload == "question"]
        datagrams = [self._datagram(name, "answer") for name in to]
        while self._sends and self._sends[-1][0] <= now_ns:
            datagrams.append(self._datagram(self._sends.pop()[1], "question"))
        return Action(datagrams)

    def _datagram(self, to: str, what: str) -> Datagram:
        flow = f"{self._name} to {to}"
        number = self._numbers[flow] = self._numbers.get(flow, -1) + 1
        return Datagram(to, 10, flow, number, what)


class Delays:
    """A network in which the n-th packet takes the n-th delay, or is lost after 0 ns for None."""

    def __init__(self, delays_ns: Sequence[int | None]) -> None:
        self._delays_ns = delays_ns
        self._events: list[tuple[int, int, bool, str]] = []
        self._now_ns = 0
        self.got: list[Packet] = []

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        assert to_ns >= self._now_ns - 1
        for packet in packets:
            assert packet.sent_ns <= packet.enters_ns <= to_ns
            delay_ns = self._delays_ns[packet.packet_id % len(self._delays_ns)]
            event = packet.enters_ns + (delay_ns or 0), packet.packet_id, delay_ns is not LOST, packet.destination
            heapq.heappush(self._events, event)
        self.got += packets
        self._now_ns = to_ns
        arrivals, drops = [], []
        while self._events and self._events[0][0] <= to_ns:
            at_ns, packet_id, arrives, destination = heapq.heappop(self._events)
            if arrives:
                arrivals.append(Arrival(packet_id, destination, at_ns))
            else:
                drops.append(Drop(packet_id, "lost"))
        return arrivals, drops

    def next_event_ns(self) -> int | None:
        return self._events[0][0] if self._events else None


@dataclass
class ScriptedPolicy:
    """A policy whose windows were written down, of any kind."""

    lengths_ns: Sequence[int]
    holds_sends: bool
    knows_end: bool
    holds_arrivals: bool
    name: str = "scripted"
    exact: bool = False
    asked: int = 0

    def next_window(self, situation: Situation) -> int:
        self.asked += 1
        return situation.now_ns + self.lengths_ns[self.asked % len(self.lengths_ns)]


@dataclass
class Setting:
    """A co-simulation that can be run again.

    Attributes:
        lengths_ns: Of its windows, in turn.
        flags: Of its policy.
        sends: What each agent sends: when, and to whom.
        delays_ns: Of its network.
        step_ns: Of its physics.
    """

    lengths_ns: Sequence[int]
    flags: tuple[bool, bool, bool]
    sends: Mapping[str, Sequence[tuple[int, str]]]
    delays_ns: Sequence[int | None]
    step_ns: int
    programs: dict[str, Scripted] = field(default_factory=dict)
    network: Delays = field(init=False)

    def run(self, observer: WindowObserver | None = None, *, backwards: bool = False) -> Run:
        names = NAMES[::-1] if backwards else NAMES
        self.programs = {name: Scripted(name, self.sends[name]) for name in names}
        self.network = Delays(self.delays_ns)
        agents = Agents(Drifting(names, self.step_ns), self.programs)
        pairs = [(one, other) for one in NAMES for other in NAMES if one != other]
        policy = ScriptedPolicy(self.lengths_ns, *self.flags)
        return Coordinator(agents, self.network, policy, pairs, observer=observer).advance(END_NS)


SENDS = st.lists(st.tuples(st.integers(0, END_NS), st.sampled_from(NAMES)), max_size=6)
SETTINGS = st.builds(
    Setting,
    lengths_ns=st.lists(st.integers(1, 200), min_size=1, max_size=5),
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    sends=st.fixed_dictionaries(dict.fromkeys(NAMES, SENDS)),
    delays_ns=st.lists(st.one_of(st.integers(0, 300), st.just(LOST)), min_size=1, max_size=5),
    step_ns=st.integers(1, 50),
)


@given(SETTINGS)
def test_nothing_is_delivered_before_it_was_sent_and_everything_ends_once(setting: Setting) -> None:
    run = setting.run()
    holds_sends, knows_end, holds_arrivals = setting.flags
    assert run.windows_ns == sorted(set(run.windows_ns))
    assert run.windows_ns[-1] == END_NS
    lengths_ns = [end_ns - begin_ns for begin_ns, end_ns in pairwise([0, *run.windows_ns])]
    script = islice(cycle(setting.lengths_ns), 1, len(lengths_ns))
    assert lengths_ns[:-1] == list(script), "windows are as the policy said, but for the last"
    assert [packet.packet_id for packet in setting.network.got] == list(range(1, len(setting.network.got) + 1))
    for fate in run.fates.values():
        packet = fate.packet
        assert fate.packet.enters_ns in run.windows_ns if holds_sends else packet.enters_ns == packet.sent_ns
        delay_ns = setting.delays_ns[packet.packet_id % len(setting.delays_ns)]
        at_ns = packet.enters_ns + (delay_ns or 0)
        last_ns = END_NS if knows_end else END_NS - 1
        assert fate.is_known == (at_ns <= last_ns), "what has an end by now has it, what has none yet is under way"
        if fate.reason:
            assert delay_ns is LOST
        elif fate.arrived_ns is not None and fate.counted_ns is not None:
            assert fate.arrived_ns == at_ns
            assert fate.counted_ns >= fate.arrived_ns
            assert fate.late_ns == 0 or not holds_arrivals
            assert fate.counted_ns + fate.late_ns in run.windows_ns
    heard = [(name, *one) for name, program in setting.programs.items() for one in program.heard]
    for _, now_ns, received in heard:
        assert received.sent_ns <= received.arrived_ns <= now_ns
    arrived = [fate for fate in run.fates.values() if fate.arrived_ns is not None]
    assert len(heard) <= len(arrived), "what arrives in the last window is not heard any more"
    assert len(arrived) - len(heard) == sum(
        fate.counted_ns is not None and fate.counted_ns + fate.late_ns == END_NS for fate in arrived
    )


@dataclass
class Watching:
    """An observer that keeps everything."""

    windows: list[Window] = field(default_factory=list)
    ended: list[tuple[tuple[str, int], int | None]] = field(default_factory=list)

    def begin(self, states: Mapping[str, State]) -> None:
        self.first = states

    def window(self, window: Window) -> None:
        self.windows.append(window)
        self.ended += [(fate.packet.identity, fate.arrived_ns) for fate in window.ended]


@given(SETTINGS)
def test_the_network_knows_the_states_that_the_policy_says(setting: Setting) -> None:
    watching = Watching()
    setting.run(watching)
    for window in watching.windows:
        known_at_ns = window.end_ns if setting.flags[1] else window.begin_ns
        for fate in window.entered:
            for known, true in zip(fate.known, fate.true, strict=True):
                assert known.position_m[0] == known_at_ns // setting.step_ns * setting.step_ns
                assert true.position_m[0] == fate.packet.sent_ns // setting.step_ns * setting.step_ns


@given(SETTINGS)
def test_the_digest_depends_on_no_observer_and_no_order_of_names(setting: Setting) -> None:
    run, watching = setting.run(), Watching()
    assert setting.run(watching).digest == run.digest
    assert setting.run(backwards=True).digest == run.digest


@given(SETTINGS)
def test_an_observer_is_told_everything_once_and_in_order(setting: Setting) -> None:
    watching = Watching()
    run = setting.run(watching)
    assert [window.end_ns for window in watching.windows] == run.windows_ns
    assert [window.begin_ns for window in watching.windows] == [0, *run.windows_ns[:-1]]
    entered = [fate for window in watching.windows for fate in window.entered]
    assert entered == list(run.fates.values())
    known: list[Fate] = [fate for fate in run.fates.values() if fate.is_known]
    assert sorted(watching.ended) == sorted((fate.packet.identity, fate.arrived_ns) for fate in known)
    for part, total_s in run.wall_s.items():
        assert sum(window.wall_s[part] for window in watching.windows) == pytest.approx(total_s)
    before = watching.first
    for window in watching.windows:
        assert window.known == (window.states if setting.flags[1] else before)
        before = window.states


@given(SETTINGS, SETTINGS)
def test_other_runs_have_other_digests(one: Setting, other: Setting) -> None:
    first, second = one.run(), other.run()
    same = first.windows_ns == second.windows_ns and [
        (fate.packet, fate.arrived_ns, fate.reason) for fate in first.fates.values()
    ] == [(fate.packet, fate.arrived_ns, fate.reason) for fate in second.fates.values()]
    assert (first.digest == second.digest) == same


HERE = State((0.0, 0.0, 0.0))
SENT = Packet(7, "a", "b", 10, ("a to b", 3), 100, 110, "udp")
ARRIVED = Fate(SENT, (HERE, HERE), (HERE, HERE), arrived_ns=120, counted_ns=130)


def digest(entered: Sequence[Fate], ended: Sequence[Fate], end_ns: int = 130) -> str:
    """Return the digest of one window."""
    found = EventDigest()
    found.window(end_ns, entered, ended)
    return found.hexdigest()


def test_whatever_differs_in_a_window_is_in_the_digest() -> None:
    fields: dict[str, Any] = {
        "packet_id": 8,
        "source": "c",
        "destination": "c",
        "size_bytes": 11,
        "identity": ("a to b", 4),
    }
    fields |= {"sent_ns": 101, "enters_ns": 111, "protocol": "tcp"}
    others = [replace(ARRIVED, packet=replace(SENT, **{name: value})) for name, value in fields.items()]
    others.append(replace(ARRIVED, packet=replace(SENT, identity=("a to c", 3))))
    fates = [ARRIVED, replace(ARRIVED, arrived_ns=121)]
    fates += [replace(ARRIVED, arrived_ns=None, reason=reason) for reason in ("lost", "late")]
    found = [digest([one], [ARRIVED]) for one in (ARRIVED, *others)]
    found += [digest([ARRIVED], [one]) for one in fates[1:]]
    found += [digest([ARRIVED], []), digest([], [ARRIVED]), digest([ARRIVED], [ARRIVED], 131)]
    assert len(set(found)) == len(found) == len(fields) + 2 + 3 + 3


def test_quiet_windows_are_hashed_as_all_others() -> None:
    """By hand, as recordings have it: each event's mark, number and time, in order."""
    found = EventDigest()
    for end_ns in (100, 110):
        found.quiet_ns.append(end_ns)
    found.window(130, [ARRIVED], [ARRIVED])
    found.quiet_ns.append(140)
    events = struct.pack("<cQQcQQ", b"w", 0, 100, b"w", 1, 110)
    events += struct.pack("<QqqQQ", 7, 3, 10, 100, 110) + b"a\0b\0a to b\0udp\0"
    events += struct.pack("<cQQcQQcQQ", b"a", 7, 120, b"w", 2, 130, b"w", 3, 140)
    assert found.hexdigest() == hashlib.blake2b(events, digest_size=16).hexdigest()
    found.quiet_ns.append(150)
    events += struct.pack("<cQQ", b"w", 4, 150)
    assert found.hexdigest() == hashlib.blake2b(events, digest_size=16).hexdigest()
