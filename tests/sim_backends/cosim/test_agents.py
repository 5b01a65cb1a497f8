"""Wake times of programs, for any sequence of planned times, and agents that appear and disappear during a run."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Action
from sim_backends.cosim.packet_ledger import ABSENT
from sim_backends.cosim.policies.registry import BUILTIN, make_policy
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.network.disc import Disc
from sim_backends.network.packets import ReceivedDatagram
from sim_backends.world.motion import State

NAMES = ("a", "b", "c")
MS = 1_000_000
END_NS = 100
RECEIVED_AT_NS = range(0, END_NS, 10)


class StationaryPhysics:
    step_ns = 1
    limits_m_s2: Mapping[str, float] = dict.fromkeys(NAMES, 0.0)

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        return dict.fromkeys(NAMES, State((0.0, 0.0, 0.0)))


class ScheduledProgram:
    """A program whose times between wakes are the items of a list; after None it has no timer."""

    def __init__(self, name: str, delays_ns: Sequence[int | None], wakes: list[tuple[int, str]]) -> None:
        self._name = name
        self._delays_ns = list(delays_ns)[::-1]
        self._wakes = wakes
        self._wake_ns = self._next_ns(0)

    def _next_ns(self, now_ns: int) -> int | None:
        delay_ns = self._delays_ns.pop() if self._delays_ns else None
        return None if delay_ns is None else now_ns + delay_ns

    def next_wake_ns(self) -> int | None:
        return self._wake_ns

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self._wakes.append((now_ns, self._name))
        self._wake_ns = self._next_ns(now_ns)
        return Action()


PLANS = st.fixed_dictionaries(
    {name: st.lists(st.one_of(st.integers(1, 60), st.none()), max_size=12) for name in NAMES}
)
RECEIVERS = st.lists(st.sets(st.sampled_from(NAMES)), min_size=len(RECEIVED_AT_NS), max_size=len(RECEIVED_AT_NS))


@given(PLANS, RECEIVERS)
def test_programs_wake_at_their_last_planned_time_and_when_they_receive(
    plans: dict[str, list[int | None]], receivers: list[set[str]]
) -> None:
    wakes: list[tuple[int, str]] = []
    agents = Agents(StationaryPhysics(), {name: ScheduledProgram(name, plan, wakes) for name, plan in plans.items()})
    expected: list[tuple[int, str]] = []
    programs = {name: ScheduledProgram(name, plan, expected) for name, plan in plans.items()}
    state = State((0.0, 0.0, 0.0))
    for now_ns, names in zip(RECEIVED_AT_NS, receivers, strict=True):
        for name in sorted(names):
            agents.deliver(name, ReceivedDatagram("x", None, now_ns, now_ns))
            programs[name].wake(now_ns, state, ())
        agents.advance(now_ns, now_ns + 9, now_ns + 9)
        for at_ns in range(now_ns, now_ns + 10):
            for name in NAMES:
                if programs[name].next_wake_ns() == at_ns:
                    programs[name].wake(at_ns, state, ())
        assert wakes == expected
        planned_wakes_ns = [
            wake_ns for program in programs.values() if (wake_ns := program.next_wake_ns()) is not None
        ]
        assert agents.next_wake_ns() == min(planned_wakes_ns, default=None)


class PhysicsWithLateAgent(StationaryPhysics):
    """Physics in which an agent appears within a window."""

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        late_states = {"late": State((3.0, 4.0, 0.0))} if to_ns >= 12 * MS else {}
        return {**super().advance(to_ns, commands), **late_states}


@pytest.mark.parametrize("extrapolates", [False, True])
@pytest.mark.parametrize("policy", BUILTIN)
def test_an_agent_that_appears_during_a_run_can_receive_with_every_policy(policy: str, *, extrapolates: bool) -> None:
    physics = PhysicsWithLateAgent()
    physics.step_ns = MS
    programs = {
        "a": Periodic("to late", "late", period_ns=7 * MS, first_ns=13 * MS),
        "b": Periodic("to a", "a", period_ns=MS),
    }
    network = Disc(10.0, 1000, extrapolates=extrapolates)
    sync_policy = make_policy(policy, window_s=0.005, longest_s=0.02)
    run = Coordinator(Agents(physics, programs), network, sync_policy, [("b", "a")]).advance(60 * MS)
    fates_to_late_agent = [fate for fate in run.fates.values() if fate.packet.destination == "late"]
    assert len(fates_to_late_agent) >= 5
    assert all(fate.assumed_states[1].position_m == (3.0, 4.0, 0.0) for fate in fates_to_late_agent)
    assert not any(fate.reason for fate in run.fates.values())


class PhysicsWithAbsentAgent(StationaryPhysics):
    """Physics in which an agent disappears within a window, and appears again later."""

    agents_disappear = True

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        states = super().advance(to_ns, commands)
        return {name: state for name, state in states.items() if name != "b" or not 12 * MS <= to_ns < 32 * MS}


@pytest.mark.parametrize("extrapolates", [False, True])
@pytest.mark.parametrize("policy", BUILTIN)
def test_an_agent_that_the_physics_removes_is_absent_with_every_policy(policy: str, *, extrapolates: bool) -> None:
    physics = PhysicsWithAbsentAgent()
    physics.step_ns = MS
    programs = {
        "a": Periodic("to b", "b", period_ns=MS, first_ns=MS // 2),
        "b": Periodic("to a", "a", period_ns=MS, first_ns=MS // 2),
    }
    network = Disc(10.0, 2 * MS, extrapolates=extrapolates)
    sync_policy = make_policy(policy, window_s=0.005, longest_s=0.02)
    run = Coordinator(Agents(physics, programs), network, sync_policy, [("a", "b"), ("b", "a")]).advance(60 * MS)
    fates = {name: [fate for (flow, _), fate in run.fates.items() if flow == name] for name in ("to a", "to b")}
    assert len(fates["to b"]) >= 55
    assert 30 < len(fates["to a"]) <= 60 - 15, "its program sends nothing while the agent is absent"
    assert {fate.reason for name in fates for fate in fates[name]} == {"", ABSENT}
    send_times_of_lost_ns = [fate.packet.sent_ns for fate in fates["to b"] if fate.reason]
    assert {*range(15, 30)} <= {at_ns // MS for at_ns in send_times_of_lost_ns}
    assert all(4 * MS <= at_ns < 37 * MS for at_ns in send_times_of_lost_ns)
    assert any(fate.arrived_ns is not None and fate.arrived_ns > 40 * MS for fate in fates["to a"])
