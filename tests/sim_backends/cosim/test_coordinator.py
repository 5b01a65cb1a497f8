"""The coordinator with federates that return random scripted answers."""

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
from sim_backends.cosim.federates import Action
from sim_backends.cosim.policies.sync_policy import Situation
from sim_backends.cosim.run_record import EventDigest, Fate, Run, Window, WindowObserver
from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, ReceivedDatagram
from sim_backends.world.motion import State

NAMES = ("a", "b", "c")
END_NS = 1_000
LOST = None


class UniformMotion:
    """Agents whose position in metres is the time in nanoseconds, at whole steps."""

    def __init__(self, names: Sequence[str], step_ns: int) -> None:
        self._names = names
        self.step_ns = step_ns
        self.limits_m_s2: Mapping[str, float] = dict.fromkeys(names, 0.0)
        self.times_ns: list[int] = [0]

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        assert to_ns >= self.times_ns[-1], "times never decrease"
        self.times_ns.append(to_ns)
        return {name: State((float(to_ns // self.step_ns * self.step_ns), 0.0, 0.0)) for name in self._names}


class ScriptedProgram:
    """Sends at given times, and replies to every datagram that is not a reply."""

    def __init__(self, name: str, sends: Sequence[tuple[int, str]]) -> None:
        self._name = name
        self._sends = sorted(sends)[::-1]
        self._numbers: dict[str, int] = {}
        self.received: list[tuple[int, ReceivedDatagram]] = []

    def next_wake_ns(self) -> int | None:
        return self._sends[-1][0] if self._sends else None

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self.received += [(now_ns, datagram) for datagram in received]
        requesters = [datagram.source for datagram in received if datagram.payload == "request"]
        datagrams = [self._datagram(name, "reply") for name in requesters]
        while self._sends and self._sends[-1][0] <= now_ns:
            datagrams.append(self._datagram(self._sends.pop()[1], "request"))
        return Action(datagrams)

    def _datagram(self, receiver: str, payload: str) -> Datagram:
        flow = f"{self._name} to {receiver}"
        number = self._numbers[flow] = self._numbers.get(flow, -1) + 1
        return Datagram(receiver, 10, flow, number, payload)


class DelayNetwork:
    """A network in which the n-th packet has the n-th delay, or is dropped after 0 ns if that is None."""

    def __init__(self, delays_ns: Sequence[int | None]) -> None:
        self._delays_ns = delays_ns
        self._events: list[tuple[int, int, bool, str]] = []
        self._now_ns = 0
        self.entered_packets: list[Packet] = []

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        assert to_ns >= self._now_ns - 1
        for packet in packets:
            assert packet.sent_ns <= packet.enters_ns <= to_ns
            delay_ns = self._delays_ns[packet.packet_id % len(self._delays_ns)]
            event = packet.enters_ns + (delay_ns or 0), packet.packet_id, delay_ns is not LOST, packet.destination
            heapq.heappush(self._events, event)
        self.entered_packets += packets
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
    """A policy with scripted windows and any combination of flags."""

    lengths_ns: Sequence[int]
    defers_sends: bool
    uses_end_states: bool
    defers_arrivals: bool
    name: str = "scripted"
    exact: bool = False
    calls: int = 0

    def next_window(self, situation: Situation) -> int:
        self.calls += 1
        return situation.now_ns + self.lengths_ns[self.calls % len(self.lengths_ns)]


@dataclass
class RepeatableRun:
    """A co-simulation that can be run repeatedly.

    Attributes:
        lengths_ns: Lengths of its windows, repeated.
        flags: Flags of its policy.
        sends: Times and receivers of the datagrams of each agent.
        delays_ns: Delays of its network.
        step_ns: Step of its physics.
    """

    lengths_ns: Sequence[int]
    flags: tuple[bool, bool, bool]
    sends: Mapping[str, Sequence[tuple[int, str]]]
    delays_ns: Sequence[int | None]
    step_ns: int
    programs: dict[str, ScriptedProgram] = field(default_factory=dict)
    network: DelayNetwork = field(init=False)

    def run(self, observer: WindowObserver | None = None, *, backwards: bool = False) -> Run:
        names = NAMES[::-1] if backwards else NAMES
        self.programs = {name: ScriptedProgram(name, self.sends[name]) for name in names}
        self.network = DelayNetwork(self.delays_ns)
        agents = Agents(UniformMotion(names, self.step_ns), self.programs)
        pairs = [(source, receiver) for source in NAMES for receiver in NAMES if source != receiver]
        policy = ScriptedPolicy(self.lengths_ns, *self.flags)
        return Coordinator(agents, self.network, policy, pairs, observer=observer).advance(END_NS)


SENDS = st.lists(st.tuples(st.integers(0, END_NS), st.sampled_from(NAMES)), max_size=6)
SETTINGS = st.builds(
    RepeatableRun,
    lengths_ns=st.lists(st.integers(1, 200), min_size=1, max_size=5),
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    sends=st.fixed_dictionaries(dict.fromkeys(NAMES, SENDS)),
    delays_ns=st.lists(st.one_of(st.integers(0, 300), st.just(LOST)), min_size=1, max_size=5),
    step_ns=st.integers(1, 50),
)


@given(SETTINGS)
def test_packets_are_delivered_after_they_were_sent_and_decided_once(setting: RepeatableRun) -> None:
    run = setting.run()
    defers_sends, uses_end_states, defers_arrivals = setting.flags
    assert run.windows_ns == sorted(set(run.windows_ns))
    assert run.windows_ns[-1] == END_NS
    lengths_ns = [end_ns - begin_ns for begin_ns, end_ns in pairwise([0, *run.windows_ns])]
    script = islice(cycle(setting.lengths_ns), 1, len(lengths_ns))
    assert lengths_ns[:-1] == list(script), "all windows but the last have the lengths of the policy"
    assert [packet.packet_id for packet in setting.network.entered_packets] == list(
        range(1, len(setting.network.entered_packets) + 1)
    )
    for fate in run.fates.values():
        packet = fate.packet
        assert fate.packet.enters_ns in run.windows_ns if defers_sends else packet.enters_ns == packet.sent_ns
        delay_ns = setting.delays_ns[packet.packet_id % len(setting.delays_ns)]
        at_ns = packet.enters_ns + (delay_ns or 0)
        last_ns = END_NS if uses_end_states else END_NS - 1
        assert fate.is_decided == (at_ns <= last_ns), "packets whose event is after the end are under way"
        if fate.reason:
            assert delay_ns is LOST
        elif fate.arrived_ns is not None and fate.counted_ns is not None:
            assert fate.arrived_ns == at_ns
            assert fate.counted_ns >= fate.arrived_ns
            assert fate.late_ns == 0 or not defers_arrivals
            assert fate.counted_ns + fate.late_ns in run.windows_ns
    all_receptions = [reception for program in setting.programs.values() for reception in program.received]
    for now_ns, datagram in all_receptions:
        assert datagram.sent_ns <= datagram.arrived_ns <= now_ns
    arrived_fates = [fate for fate in run.fates.values() if fate.arrived_ns is not None]
    assert len(all_receptions) <= len(arrived_fates), "arrivals in the last window are not delivered any more"
    assert len(arrived_fates) - len(all_receptions) == sum(
        fate.counted_ns is not None and fate.counted_ns + fate.late_ns == END_NS for fate in arrived_fates
    )


@dataclass
class WindowRecorder:
    """An observer that stores all windows."""

    windows: list[Window] = field(default_factory=list)
    decided_fates: list[tuple[tuple[str, int], int | None]] = field(default_factory=list)

    def begin(self, states: Mapping[str, State]) -> None:
        self.first_states = states

    def window(self, window: Window) -> None:
        self.windows.append(window)
        self.decided_fates += [(fate.packet.identity, fate.arrived_ns) for fate in window.decided_fates]


@given(SETTINGS)
def test_the_network_assumes_the_states_that_the_policy_determines(setting: RepeatableRun) -> None:
    recorder = WindowRecorder()
    setting.run(recorder)
    for window in recorder.windows:
        assumed_at_ns = window.end_ns if setting.flags[1] else window.begin_ns
        for fate in window.entered_fates:
            for assumed_states, true_states in zip(fate.assumed_states, fate.true_states, strict=True):
                assert assumed_states.position_m[0] == assumed_at_ns // setting.step_ns * setting.step_ns
                assert true_states.position_m[0] == fate.packet.sent_ns // setting.step_ns * setting.step_ns


@given(SETTINGS)
def test_the_digest_is_independent_of_observers_and_of_the_order_of_names(setting: RepeatableRun) -> None:
    run, recorder = setting.run(), WindowRecorder()
    assert setting.run(recorder).digest == run.digest
    assert setting.run(backwards=True).digest == run.digest


@given(SETTINGS)
def test_an_observer_receives_each_window_and_fate_once_and_in_order(setting: RepeatableRun) -> None:
    recorder = WindowRecorder()
    run = setting.run(recorder)
    assert [window.end_ns for window in recorder.windows] == run.windows_ns
    assert [window.begin_ns for window in recorder.windows] == [0, *run.windows_ns[:-1]]
    entered_fates = [fate for window in recorder.windows for fate in window.entered_fates]
    assert entered_fates == list(run.fates.values())
    decided_fates: list[Fate] = [fate for fate in run.fates.values() if fate.is_decided]
    assert sorted(recorder.decided_fates) == sorted((fate.packet.identity, fate.arrived_ns) for fate in decided_fates)
    for part, total_s in run.wall_s.items():
        assert sum(window.wall_s[part] for window in recorder.windows) == pytest.approx(total_s)
    begin_states = recorder.first_states
    for window in recorder.windows:
        assert window.assumed_states == (window.states if setting.flags[1] else begin_states)
        begin_states = window.states


@given(SETTINGS, SETTINGS)
def test_different_runs_have_different_digests(setting: RepeatableRun, other: RepeatableRun) -> None:
    first, second = setting.run(), other.run()
    is_equal = first.windows_ns == second.windows_ns and [
        (fate.packet, fate.arrived_ns, fate.reason) for fate in first.fates.values()
    ] == [(fate.packet, fate.arrived_ns, fate.reason) for fate in second.fates.values()]
    assert (first.digest == second.digest) == is_equal


ORIGIN = State((0.0, 0.0, 0.0))
PACKET = Packet(7, "a", "b", 10, ("a to b", 3), 100, 110, "udp")
ARRIVED_FATE = Fate(PACKET, (ORIGIN, ORIGIN), (ORIGIN, ORIGIN), arrived_ns=120, counted_ns=130)


def digest(entered_fates: Sequence[Fate], decided_fates: Sequence[Fate], end_ns: int = 130) -> str:
    """Return the digest of one window."""
    event_digest = EventDigest()
    event_digest.add_window(end_ns, entered_fates, decided_fates)
    return event_digest.hexdigest()


def test_every_difference_in_a_window_changes_the_digest() -> None:
    fields: dict[str, Any] = {
        "packet_id": 8,
        "source": "c",
        "destination": "c",
        "size_bytes": 11,
        "identity": ("a to b", 4),
    }
    fields |= {"sent_ns": 101, "enters_ns": 111, "protocol": "tcp"}
    changed_fates = [replace(ARRIVED_FATE, packet=PACKET._replace(**{name: value})) for name, value in fields.items()]
    changed_fates.append(replace(ARRIVED_FATE, packet=PACKET._replace(identity=("a to c", 3))))
    fates = [ARRIVED_FATE, replace(ARRIVED_FATE, arrived_ns=121)]
    fates += [replace(ARRIVED_FATE, arrived_ns=None, reason=reason) for reason in ("lost", "late")]
    digests = [digest([fate], [ARRIVED_FATE]) for fate in (ARRIVED_FATE, *changed_fates)]
    digests += [digest([ARRIVED_FATE], [fate]) for fate in fates[1:]]
    digests += [digest([ARRIVED_FATE], []), digest([], [ARRIVED_FATE]), digest([ARRIVED_FATE], [ARRIVED_FATE], 131)]
    assert len(set(digests)) == len(digests) == len(fields) + 2 + 3 + 3


def test_quiet_windows_are_hashed_like_all_others() -> None:
    """The expected digest is that of the mark, number and time of each event, in order."""
    event_digest = EventDigest()
    for end_ns in (100, 110):
        event_digest.quiet_ends_ns.append(end_ns)
    event_digest.add_window(130, [ARRIVED_FATE], [ARRIVED_FATE])
    event_digest.quiet_ends_ns.append(140)
    events = struct.pack("<cQQcQQ", b"w", 0, 100, b"w", 1, 110)
    events += struct.pack("<QqqQQ", 7, 3, 10, 100, 110) + b"a\0b\0a to b\0udp\0"
    events += struct.pack("<cQQcQQcQQ", b"a", 7, 120, b"w", 2, 130, b"w", 3, 140)
    assert event_digest.hexdigest() == hashlib.blake2b(events, digest_size=16).hexdigest()
    event_digest.quiet_ends_ns.append(150)
    events += struct.pack("<cQQ", b"w", 4, 150)
    assert event_digest.hexdigest() == hashlib.blake2b(events, digest_size=16).hexdigest()
