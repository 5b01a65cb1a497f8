"""The bound of `error_bounded` for all transmitters: random scenarios, and the relay and jammer of a radio."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Vector
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.comparison import compare_runs
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.packet_ledger import position_error_m
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import PolicyError
from sim_backends.cosim.policies.window_policies import Scheduled
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.paths import Paths
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State, WayPoints
from tests.helpers.nightly import examples

STEP_NS: Final = 1_000_000
END_NS: Final = 400 * STEP_NS
NAMES: Final = ("a", "b", "c", "d")
MAST_M: Final = (3.0, -2.0, 5.0)


@dataclass
class StateRecorder(Disc):
    """A network that records the states that it assumes whenever a packet enters or arrives."""

    extrapolates: bool
    transmitters: Sequence[str]
    fixed_emitters_m: Sequence[Vector]
    assumptions: list[tuple[int, Mapping[str, State]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(1e6, 3_456_789, extrapolates=self.extrapolates)

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        arrivals, drops = super().advance(to_ns, packets, states)
        for at_ns in (*(packet.enters_ns for packet in packets), *(arrival.at_ns for arrival in arrivals)):
            now = states.at(at_ns) if isinstance(states, DeadReckoned) else states
            self.assumptions.append((at_ns, {name: now[name] for name in NAMES if name in now}))
        return arrivals, drops


PLACES = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0, 5))
MOTIONS = st.tuples(st.lists(PLACES, min_size=1, max_size=5), st.floats(0.05, 20.0))


@settings(max_examples=examples(60))
@given(
    motions=st.tuples(MOTIONS, MOTIONS, MOTIONS, MOTIONS),
    transmitters=st.sets(st.sampled_from(["c", "d"])),
    has_mast=st.booleans(),
    bound_m=st.floats(0.002, 0.5),
    extrapolates=st.booleans(),
    period_ns=st.integers(STEP_NS // 3, 90 * STEP_NS),
    pauses_ns=st.lists(st.integers(1, END_NS), max_size=4),
)
def test_no_position_error_exceeds_the_bound(
    *,
    motions: Sequence[tuple[list[Vector], float]],
    transmitters: set[str],
    has_mast: bool,
    bound_m: float,
    extrapolates: bool,
    period_ns: int,
    pauses_ns: list[int],
) -> None:
    """The true positions are those of each motion, extrapolated between the steps of the physics."""
    motions_by_name = {name: WayPoints(name, *motion) for name, motion in zip(NAMES, motions, strict=True)}
    network = StateRecorder(extrapolates, sorted(transmitters), [MAST_M] if has_mast else [])
    agents = Agents(Paths([*motions_by_name.values()]), {"a": Periodic("a", "b", period_ns=period_ns)})
    coordinator = Coordinator(agents, network, ErrorBounded(bound_m, 0.2), [("a", "b")])
    try:
        for to_ns in sorted({*pauses_ns, END_NS}):
            coordinator.advance(to_ns)
    except PolicyError:
        fastest_m_s = max(speed_m_s for _, speed_m_s in motions)
        assert not extrapolates, "without extrapolation, one step may exceed the bound"
        assert 2 * fastest_m_s * STEP_NS / 1e9 > bound_m

    names = ["a", "b", *transmitters]
    assert network.assumptions or not extrapolates
    for at_ns, assumed_states in network.assumptions:
        step_ns = at_ns // STEP_NS * STEP_NS
        true_m = {name: _extrapolated_m(motions_by_name[name].at(step_ns)[name], at_ns - step_ns) for name in names}
        errors_m = [
            tuple(assumed - true for assumed, true in zip(assumed_states[name].position_m, true_m[name], strict=True))
            for name in names
        ]
        largest_error_m = max(
            math.dist(first, second) for first, second in combinations([*errors_m, (0.0, 0.0, 0.0)], 2)
        )
        assert largest_error_m <= bound_m * (1 + 1e-6) + 1e-9, f"at {at_ns} ns"
    for fate in coordinator.run.fates.values():
        assert position_error_m(fate) <= bound_m * (1 + 1e-6) + 1e-9


def _extrapolated_m(state: State, duration_ns: int) -> tuple[float, ...]:
    return tuple(x + v * duration_ns / 1e9 for x, v in zip(state.position_m, state.velocity_m_s, strict=True))


def test_the_bound_includes_the_host_of_a_ros_1_master_because_it_sends_to_all() -> None:
    simulation = build(load_scenario("field_30ft", {"topology": "masterless"}))
    assert simulation.coordinator.situation.other_agents == ("drone",)


@pytest.mark.parametrize("role", ["relay", "jammer"])
def test_the_bound_and_the_errors_include_agents_that_forward_or_interfere(role: str) -> None:
    """A drone flies between two stationary robots, whose positions alone would have no error."""
    drone = {
        "robot": "iris",
        "at_m": [25, 15],
        "height": "8m",
        "radio": {},
        "motion": {"kind": "way-points", "points_m": [[25, 35], [25, 15]], "speed": "6m/s"},
    }
    changes = {
        "agents": {
            "sender": {"robot": "husky", "at_m": [20, 12], "radio": {}},
            "receiver": {"robot": "husky", "at_m": [30, 12], "radio": {}},
            "drone": drone,
        },
        "traffic": [{"kind": "stream", "from": "sender", "to": "receiver", "rate": "50Hz"}],
        "duration": "4s",
        **(
            {"topology": "master", "relay": "drone"}
            if role == "relay"
            else {"faults": [{"kind": "jammer", "power_dbm": -60, "agent": "drone"}]}
        ),
    }
    scenario = load_scenario("convoy", changes)
    runs = {
        name: build(scenario, policy=policy).run()
        for name, policy in (("bounded", ErrorBounded(0.01)), ("scheduled", Scheduled(0.1)))
    }
    assert max(position_error_m(fate) for fate in runs["bounded"].fates.values()) <= 0.01
    assert len(runs["bounded"].windows_ns) > 60, "the drone accelerates"
    assert compare_runs(runs["bounded"], runs["scheduled"]).position_error_m.largest > 0.1


def test_the_errors_include_a_jammer_at_a_fixed_position_if_two_robots_move_side_by_side() -> None:
    """Their distance does not change, but their distances from the jammer do."""
    motions = [WayPoints(name, [(0.0, y, 0.0), (9.0, y, 0.0)], 2.0) for name, y in (("a", 0.0), ("b", 1.0))]
    for emitters_m, expected_m in ((), 0.0), ([MAST_M], 0.2):
        network = StateRecorder(False, (), emitters_m)
        agents = Agents(Paths(motions), {"a": Periodic("a", "b", period_ns=3 * STEP_NS)})
        run = Coordinator(agents, network, Scheduled(0.1), [("a", "b")]).advance(2000 * STEP_NS)
        assert max(map(position_error_m, run.fates.values())) == pytest.approx(expected_m, abs=0.005)


def test_a_bound_that_one_step_of_the_physics_exceeds_is_refused_with_a_remedy() -> None:
    physics = Paths(
        [WayPoints("a", [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)], 20.0), WayPoints("b", [(5.0, 0.0, 0.0)], 1)]
    )
    agents = Agents(physics, {"a": Periodic("a", "b", period_ns=STEP_NS)})
    message = r"0\.001 s, the position error of a and b may reach 0\.02 m; the bound is 0\.01 m"
    with pytest.raises(PolicyError, match=message):
        Coordinator(agents, Disc(100.0, 1), ErrorBounded(0.01), [("a", "b")]).advance(END_NS)
