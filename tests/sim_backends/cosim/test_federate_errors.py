"""A party that does not answer in time, fails, or gives an impossible answer is named."""

import copy
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federate_errors import FederateError, UnansweredError
from sim_backends.cosim.federates import Action, NetworkFederate, PhysicsFederate, Program
from sim_backends.cosim.observer import WindowObserver
from sim_backends.cosim.policies.base import Situation, SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.policies.sliding_window import SlidingWindow
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.stalls import Stall, stalled
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, Received
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import State, WayPoints

MS = 1_000_000
FOR_EVER_S = 3600.0
LIMIT_S = 0.25


def paths() -> Paths:
    return Paths([WayPoints(name, [(0.0, 0.0, 0.0)], 1.0) for name in "ab"])


def periodic(destination: str = "b") -> Periodic:
    return Periodic("ab", destination, period_ns=10 * MS, first_ns=2 * MS)


def two(
    *,
    physics: PhysicsFederate | None = None,
    network: NetworkFederate | None = None,
    program: Program | None = None,
    policy: SyncPolicy | None = None,
    observer: WindowObserver | None = None,
) -> Coordinator:
    return Coordinator(
        Agents(physics or paths(), {"a": program or periodic()}),
        network or Disc(1.0, MS),
        policy or SlidingWindow(0.003),
        [("a", "b")],
        observer=observer,
    )


@pytest.mark.parametrize(
    ("who", "asked"),
    [
        ("physics", "physics has not answered for 0.25 s: asked to advance from 0.006 s to 0.009 s"),
        ("network", "network has not answered for 0.25 s: asked to advance from 0.006 s to 0.009 s"),
        ("program", "the program of a has not answered for 0.25 s: asked to act at 0.012 s"),
    ],
)
def test_who_does_not_answer_within_the_deadline_is_named_with_what_it_was_asked(who: str, asked: str) -> None:
    stall = Stall(7 * MS, FOR_EVER_S, LIMIT_S)
    hanging = {
        "physics": lambda: two(physics=stalled(paths(), stall)),
        "network": lambda: two(network=stalled(Disc(1.0, MS), stall)),
        "program": lambda: two(program=stalled(periodic(), stall)),
    }[who]()
    with pytest.raises(UnansweredError) as raised:
        hanging.advance(1000 * MS)
    assert raised.value.what == asked
    assert raised.value.remedy
    whole = {"physics": 6, "network": 6, "program": 9}[who] * MS
    assert hanging.run.windows_ns[-1] == whole, "what went before is kept"
    assert hanging.run.digest == two().advance(whole).digest


def test_a_policy_that_looks_ahead_is_named_with_how_far_the_window_has_come() -> None:
    class Faulty(ErrorBounded):
        def goes_on(self, situation: Situation) -> int:
            if situation.now_ns >= 7 * MS:
                next(iter(()))
            return situation.now_ns + MS

    with pytest.raises(FederateError, match=r"policy error_bounded failed when .* StopIteration") as raised:
        two(policy=Faulty()).advance(1000 * MS)
    assert "say until when the window goes on that has come to 0.007 s" in str(raised.value)


@pytest.mark.parametrize("who", ["agents", "network"])
def test_a_stall_below_the_deadline_is_wait_and_changes_nothing_else(who: str) -> None:
    stall = Stall(7 * MS, 0.03, LIMIT_S)
    waiting = (
        two(physics=stalled(paths(), stall)) if who == "agents" else two(network=stalled(Disc(1.0, MS), stall))
    ).advance(1000 * MS)
    plain = two().advance(1000 * MS)
    assert waiting.wall_s["wait"] >= 0.03
    assert waiting.wall_s[who] > 0, "it did not wait only"
    assert plain.wall_s["wait"] == 0
    assert (waiting.digest, waiting.fates) == (plain.digest, plain.fates)


def test_what_stalls_can_be_copied_and_has_what_its_party_has() -> None:
    copied = copy.deepcopy(stalled(paths(), Stall(7 * MS, 0.0)))
    assert copied.step_ns == paths().step_ns
    assert not hasattr(copied, "next_event_ns")


def test_all_stalls_of_one_party_are_wait() -> None:
    network = Disc(1.0, MS)
    twice = stalled(stalled(network, Stall(7 * MS, 0.01)), Stall(20 * MS, 0.02))
    assert two(network=twice).advance(1000 * MS).wall_s["wait"] >= 0.03


class Failing:
    """Fails, as everything may, from a time on."""

    step_ns = MS
    limits_m_s2: Mapping[str, float] = {}

    def __init__(self, from_ns: int) -> None:
        self._from_ns = from_ns

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        if to_ns >= self._from_ns:
            raise KeyError("wheel")
        return dict.fromkeys("ab", State((0.0, 0.0, 0.0)))

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        raise RuntimeError("no plan")

    def next_wake_ns(self) -> int:
        if not self._from_ns:
            raise OSError("no clock")
        return 5 * MS


class FailingDisc(Disc):
    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        if packets:
            raise ValueError("no air")
        return [], []


class Broken(Disc):
    def next_event_ns(self) -> int | None:
        raise ValueError("no heap")


@pytest.mark.parametrize(
    ("of", "said"),
    [
        ({"physics": Failing(10 * MS)}, r"physics failed when .* from 0\.009 s to 0\.012 s: KeyError: 'wheel'"),
        ({"network": FailingDisc(1.0, MS)}, r"network failed when .* from 0 s to 0\.003 s: ValueError: no air"),
        (
            {"network": Broken(1.0, MS), "policy": EventDriven()},
            r"network failed when .* its next event after 0 s: ValueError: no heap",
        ),
        ({"program": Failing(MS)}, r"the program of a failed when .* act at 0\.005 s: RuntimeError: no plan"),
        ({"program": Failing(0)}, r"the program of a failed when .* wakes next after 0 s: OSError: no clock"),
    ],
)
def test_who_fails_is_named_with_its_last_time(of: dict[str, Any], said: str) -> None:
    with pytest.raises(FederateError, match=said) as raised:
        two(**of).advance(1000 * MS)
    assert raised.value.__cause__ is not None


class Answers:
    """A network that gives the answer it is told to, in the window in which it gets its first packet."""

    def __init__(self, arrivals: Sequence[Arrival] = (), drops: Sequence[Drop] = ()) -> None:
        self._answer = list(arrivals), list(drops)

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        return self._answer if packets else ([], [])

    def next_event_ns(self) -> int | None:
        return None


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (Answers([Arrival(2, "b", 2 * MS)]), "told the fate of packet 2, which it never got"),
        (Answers([Arrival(1, "b", 2 * MS)] * 2), "packet 1, whose fate it has told already"),
        (Answers([Arrival(1, "b", 2 * MS)], [Drop(1, "lost")]), "packet 1, whose fate it has told already"),
        (Answers([Arrival(1, "a", 2 * MS)]), "delivered packet 1 for b to a"),
        (Answers([Arrival(1, "b", 2 * MS - 1)]), r"0 s to 0\.003 s, .* entered at 0\.002 s, at 0\.001999999 s"),
        (Answers([Arrival(1, "b", 3 * MS + 1)]), r"packet 1, .* at 0\.003000001 s"),
    ],
)
def test_answers_of_the_network_that_cannot_be_are_refused(answer: Answers, said: str) -> None:
    with pytest.raises(FederateError, match=f"network.*{said}"):
        two(network=answer).advance(1000 * MS)


def test_a_physics_that_loses_an_agent_is_refused() -> None:
    class Losing(Paths):
        def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
            states = super().advance(to_ns, commands)
            return states if to_ns < 5 * MS else {"a": states["a"]}

    losing = Losing([WayPoints(name, [(0.0, 0.0, 0.0)], 1.0) for name in "ab"])
    with pytest.raises(FederateError, match=r"physics, asked to advance to 0\.006 s, has no state of b"):
        two(physics=losing).advance(1000 * MS)


def test_agents_that_nobody_moves_are_told_before_the_run() -> None:
    with pytest.raises(FederateError, match="no state of c"):
        Agents(paths(), {"c": periodic()}).states(0)
    with pytest.raises(ConfigurationError, match="c, d may send or receive"):
        Coordinator(Agents(paths(), {}), Disc(1.0, MS), EventDriven(), [("a", "c"), ("d", "b")])


def test_a_datagram_to_nobody_or_of_a_number_that_was_is_refused() -> None:
    with pytest.raises(FederateError, match="the program of a sent to c, who is no agent"):
        two(program=periodic("c")).advance(1000 * MS)

    class Twice(Periodic):
        def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
            super().wake(now_ns, own, received)
            return Action((Datagram("b", 10, "ab", 7),))

    with pytest.raises(FederateError, match="program of a sent two packets of flow ab with the number 7"):
        two(program=Twice("ab", "b", period_ns=MS)).advance(1000 * MS)


def test_progress_is_told_seldom_and_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock of the test's own: each look at it takes 1 ms."""
    ticks = iter(range(10**9))
    monkeypatch.setattr("time.perf_counter", lambda: next(ticks) / 1000)
    told: list[tuple[int, float]] = []
    two().advance(1000 * MS, lambda now_ns, wall_s: told.append((now_ns, wall_s)))
    assert 3 < len(told) < 100
    assert told == sorted(told)
    assert all(later[1] - earlier[1] >= 0.2 for earlier, later in pairwise(told))
    assert told[-1][0] <= 1000 * MS
