"""A federate or program that fails, times out, or gives an impossible answer is named in the error."""

import copy
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import (
    Action,
    FederateError,
    NetworkFederate,
    PhysicsFederate,
    Program,
    UnansweredError,
)
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import Situation, SyncPolicy
from sim_backends.cosim.policies.window_policies import EventDriven, SlidingWindow
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.run_record import WindowObserver
from sim_backends.cosim.wall_time import Stall, with_stall
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, ReceivedDatagram
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import State, WayPoints

MS = 1_000_000
ENDLESS_S = 3600.0
LIMIT_S = 0.25


def paths() -> Paths:
    return Paths([WayPoints(name, [(0.0, 0.0, 0.0)], 1.0) for name in "ab"])


def periodic(destination: str = "b") -> Periodic:
    return Periodic("ab", destination, period_ns=10 * MS, first_ns=2 * MS)


def pair(
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
    ("federate", "message"),
    [
        ("physics", "physics has not answered for 0.25 s: request to advance from 0.006 s to 0.009 s"),
        ("network", "network has not answered for 0.25 s: request to advance from 0.006 s to 0.009 s"),
        ("program", "the program of a has not answered for 0.25 s: request to act at 0.012 s"),
    ],
)
def test_a_timeout_names_the_federate_and_the_request(federate: str, message: str) -> None:
    stall = Stall(7 * MS, ENDLESS_S, LIMIT_S)
    stalled_coordinator = {
        "physics": lambda: pair(physics=with_stall(paths(), stall)),
        "network": lambda: pair(network=with_stall(Disc(1.0, MS), stall)),
        "program": lambda: pair(program=with_stall(periodic(), stall)),
    }[federate]()
    with pytest.raises(UnansweredError) as error_info:
        stalled_coordinator.advance(1000 * MS)
    assert error_info.value.what == message
    assert error_info.value.remedy
    last_window_ns = {"physics": 6, "network": 6, "program": 9}[federate] * MS
    assert stalled_coordinator.run.windows_ns[-1] == last_window_ns, "the run contains the earlier windows"
    assert stalled_coordinator.run.digest == pair().advance(last_window_ns).digest


def test_an_error_of_a_policy_that_extends_windows_states_the_time_that_the_window_has_reached() -> None:
    class FaultyPolicy(ErrorBounded):
        def extended_end_ns(self, situation: Situation) -> int:
            if situation.now_ns >= 7 * MS:
                next(iter(()))
            return situation.now_ns + MS

    with pytest.raises(
        FederateError, match=r"policy error_bounded failed at the request .* StopIteration"
    ) as error_info:
        pair(policy=FaultyPolicy()).advance(1000 * MS)
    assert "extend the window beyond 0.007 s" in str(error_info.value)


@pytest.mark.parametrize("part", ["agents", "network"])
def test_a_stall_below_the_deadline_only_adds_waiting_time(part: str) -> None:
    stall = Stall(7 * MS, 0.03, LIMIT_S)
    stalled_run = (
        pair(physics=with_stall(paths(), stall))
        if part == "agents"
        else pair(network=with_stall(Disc(1.0, MS), stall))
    ).advance(1000 * MS)
    reference_run = pair().advance(1000 * MS)
    assert stalled_run.wall_s["wait"] >= 0.03
    assert stalled_run.wall_s[part] > 0, "the remaining time is not waiting time"
    assert reference_run.wall_s["wait"] == 0
    assert (stalled_run.digest, stalled_run.fates) == (reference_run.digest, reference_run.fates)


def test_a_stalled_federate_can_be_copied_and_has_its_attributes() -> None:
    copied_physics = copy.deepcopy(with_stall(paths(), Stall(7 * MS, 0.0)))
    assert copied_physics.step_ns == paths().step_ns
    assert not hasattr(copied_physics, "next_event_ns")


def test_all_stalls_of_one_federate_count_as_waiting_time() -> None:
    network = Disc(1.0, MS)
    network_with_two_stalls = with_stall(with_stall(network, Stall(7 * MS, 0.01)), Stall(20 * MS, 0.02))
    assert pair(network=network_with_two_stalls).advance(1000 * MS).wall_s["wait"] >= 0.03


class FailingFederate:
    """Physics and a program that fail from a given time on."""

    step_ns = MS
    limits_m_s2: Mapping[str, float] = {}

    def __init__(self, from_ns: int) -> None:
        self._from_ns = from_ns

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        if to_ns >= self._from_ns:
            raise KeyError("wheel")
        return dict.fromkeys("ab", State((0.0, 0.0, 0.0)))

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
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


class NetworkWithoutEvents(Disc):
    def next_event_ns(self) -> int | None:
        raise ValueError("no heap")


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"physics": FailingFederate(10 * MS)},
            r"physics failed at the request .* from 0\.009 s to 0\.012 s: KeyError: 'wheel'",
        ),
        (
            {"network": FailingDisc(1.0, MS)},
            r"network failed at the request .* from 0 s to 0\.003 s: ValueError: no air",
        ),
        (
            {"network": NetworkWithoutEvents(1.0, MS), "policy": EventDriven()},
            r"network failed at the request .* its next event after 0 s: ValueError: no heap",
        ),
        (
            {"program": FailingFederate(MS)},
            r"the program of a failed at the request .* act at 0\.005 s: RuntimeError: no plan",
        ),
        (
            {"program": FailingFederate(0)},
            r"the program of a failed at the request .* next wake time after 0 s: OSError: no clock",
        ),
    ],
)
def test_a_failure_names_the_federate_and_its_last_time(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(FederateError, match=message) as error_info:
        pair(**parts).advance(1000 * MS)
    assert error_info.value.__cause__ is not None


class FixedAnswerNetwork:
    """A network that gives a fixed answer in the window in which its first packet enters."""

    def __init__(self, arrivals: Sequence[Arrival] = (), drops: Sequence[Drop] = ()) -> None:
        self._answer = list(arrivals), list(drops)

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        return self._answer if packets else ([], [])

    def next_event_ns(self) -> int | None:
        return None


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (FixedAnswerNetwork([Arrival(2, "b", 2 * MS)]), "reported the fate of packet 2, which never entered it"),
        (FixedAnswerNetwork([Arrival(1, "b", 2 * MS)] * 2), "packet 1, which was reported before"),
        (FixedAnswerNetwork([Arrival(1, "b", 2 * MS)], [Drop(1, "lost")]), "packet 1, which was reported before"),
        (FixedAnswerNetwork([Arrival(1, "a", 2 * MS)]), "delivered packet 1 for b to a"),
        (
            FixedAnswerNetwork([Arrival(1, "b", 2 * MS - 1)]),
            r"0 s to 0\.003 s, .* entered at 0\.002 s, at 0\.001999999 s",
        ),
        (FixedAnswerNetwork([Arrival(1, "b", 3 * MS + 1)]), r"packet 1, .* at 0\.003000001 s"),
    ],
)
def test_impossible_answers_of_the_network_are_refused(answer: FixedAnswerNetwork, message: str) -> None:
    with pytest.raises(FederateError, match=f"network.*{message}"):
        pair(network=answer).advance(1000 * MS)


def test_a_physics_that_loses_an_agent_is_refused() -> None:
    class LosingPhysics(Paths):
        def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
            states = super().advance(to_ns, commands)
            return states if to_ns < 5 * MS else {"a": states["a"]}

    physics_without_b = LosingPhysics([WayPoints(name, [(0.0, 0.0, 0.0)], 1.0) for name in "ab"])
    with pytest.raises(FederateError, match=r"physics, requested to advance to 0\.006 s, has no state of b"):
        pair(physics=physics_without_b).advance(1000 * MS)


def test_agents_without_physics_are_refused_before_the_run() -> None:
    with pytest.raises(FederateError, match="no state of c"):
        Agents(paths(), {"c": periodic()}).states(0)
    with pytest.raises(ConfigurationError, match="the physics federate has no state of c, d"):
        Coordinator(Agents(paths(), {}), Disc(1.0, MS), EventDriven(), [("a", "c"), ("d", "b")])


def test_a_datagram_to_an_unknown_agent_or_with_a_used_number_is_refused() -> None:
    with pytest.raises(FederateError, match="the program of a sent to c, which is not an agent"):
        pair(program=periodic("c")).advance(1000 * MS)

    class DuplicateSender(Periodic):
        def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
            super().wake(now_ns, own_state, received)
            return Action((Datagram("b", 10, "ab", 7),))

    with pytest.raises(FederateError, match="program of a sent two packets of flow ab with the number 7"):
        pair(program=DuplicateSender("ab", "b", period_ns=MS)).advance(1000 * MS)


def test_progress_is_reported_at_a_limited_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock is replaced by one that advances by 1 ms at each reading."""
    ticks = iter(range(10**9))
    monkeypatch.setattr("time.perf_counter", lambda: next(ticks) / 1000)
    reports: list[tuple[int, float]] = []
    pair().advance(1000 * MS, lambda now_ns, wall_s: reports.append((now_ns, wall_s)))
    assert 3 < len(reports) < 100
    assert reports == sorted(reports)
    assert all(later[1] - earlier[1] >= 0.2 for earlier, later in pairwise(reports))
    assert reports[-1][0] <= 1000 * MS
