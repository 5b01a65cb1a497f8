"""Windows of length 0: successive events at one instant take one window each, and no time."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.comparison import compare_runs
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Action
from sim_backends.cosim.policies.sync_policy import PolicyError, Situation
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.recording.manifest import RunSettings
from sim_backends.cosim.recording.recorder import RunRecorder
from sim_backends.cosim.recording.replay import read_recording
from sim_backends.cosim.run_record import WindowObserver
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import State, WayPoints

MS = 1_000_000
FIRST_SEND_NS = 7 * MS + 3


class InstantReplier:
    """Sends a datagram, or replies at the instant of its arrival, a limited number of times."""

    def __init__(self, peer: str, times: int, *, sends_first: bool = False) -> None:
        self._peer, self._remaining, self._sends_first = peer, times, sends_first
        self.wake_times_ns: list[int] = []

    def next_wake_ns(self) -> int | None:
        return FIRST_SEND_NS if self._sends_first else None

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self._sends_first = False
        self.wake_times_ns.append(now_ns)
        if not self._remaining:
            return Action()
        self._remaining -= 1
        return Action((Datagram(self._peer, 10, f"to {self._peer}", self._remaining),))


def instant_replies(replies: int, observer: WindowObserver | None = None) -> tuple[Coordinator, list[InstantReplier]]:
    """Return a co-simulation of two programs that reply at one instant, over a network without delay."""
    programs = [InstantReplier("b", replies, sends_first=True), InstantReplier("a", replies)]
    physics = Paths([WayPoints(name, [(0.0, 0.0, 0.0)], 1.0) for name in "ab"])
    agents = Agents(physics, dict(zip("ab", programs, strict=True)))
    return Coordinator(agents, Disc(1.0, 0), EventDriven(), [("a", "b"), ("b", "a")], observer=observer), programs


def test_events_at_one_instant_are_simulated_at_it_and_time_advances() -> None:
    coordinator, programs = instant_replies(20)
    run = coordinator.advance(100 * MS)
    assert len(run.fates) == 40
    assert {(fate.packet.sent_ns, fate.arrived_ns, fate.late_ns) for fate in run.fates.values()} == {
        (FIRST_SEND_NS, FIRST_SEND_NS, 0)
    }
    assert {at_ns for program in programs for at_ns in program.wake_times_ns} == {FIRST_SEND_NS}
    assert run.windows_ns == sorted(run.windows_ns)
    assert run.windows_ns[-1] == 100 * MS
    # One window ends at the first datagram, and another one at each reply.
    assert Counter(run.windows_ns)[FIRST_SEND_NS] >= 40
    assert compare_runs(run, run).delivery_error_s.largest == 0


def test_a_recording_of_empty_windows_equals_the_run(tmp_path: Path) -> None:
    with RunRecorder(tmp_path / "run", RunSettings("a: 1", "event_driven", {}, 1)) as recorder:
        live_run = instant_replies(20, recorder)[0].advance(100 * MS)
    replayed = read_recording(tmp_path / "run").run
    assert (replayed.digest, replayed.windows_ns) == (live_run.digest, live_run.windows_ns)


def test_an_instant_that_never_ends_is_an_error() -> None:
    coordinator, _ = instant_replies(10_000)
    with pytest.raises(PolicyError, match=f"time does not advance beyond {FIRST_SEND_NS} ns"):
        coordinator.advance(100 * MS)
    assert coordinator.run.windows_ns[-1] == FIRST_SEND_NS


def test_a_window_that_ends_before_it_begins_is_an_error() -> None:
    class BackwardPolicy(EventDriven):
        def next_window(self, situation: Situation) -> int | None:
            return situation.now_ns - 1 if situation.now_ns else 5 * MS

    coordinator, _ = instant_replies(1)
    coordinator.policy = BackwardPolicy()
    with pytest.raises(PolicyError, match="time does not advance beyond 5000000 ns"):
        coordinator.advance(100 * MS)
    assert coordinator.run.windows_ns == [5 * MS]
