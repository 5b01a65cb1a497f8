"""The bound of `error_bounded` over all that transmits: random scenarios, and the relay and jammer of a radio."""

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
from sim_backends.cosim.comparison import errors
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.geometry import displaced_m
from sim_backends.cosim.policies.base import PolicyError
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.scheduled import Scheduled
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.paths import Paths
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State, WayPoints

STEP_NS: Final = 1_000_000
END_NS: Final = 400 * STEP_NS
NAMES: Final = ("a", "b", "c", "d")
MAST_M: Final = (3.0, -2.0, 5.0)


@dataclass
class Spy(Disc):
    """A network that notes where it takes agents to be whenever a packet enters or arrives."""

    extrapolates: bool
    transmitters: Sequence[str]
    fixed_emitters_m: Sequence[Vector]
    used: list[tuple[int, Mapping[str, State]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(1e6, 3_456_789, extrapolates=self.extrapolates)

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        arrivals, drops = super().advance(to_ns, packets, states)
        for at_ns in (*(one.enters_ns for one in packets), *(one.at_ns for one in arrivals)):
            now = states.at(at_ns) if isinstance(states, DeadReckoned) else states
            self.used.append((at_ns, {name: now[name] for name in NAMES if name in now}))
        return arrivals, drops


PLACES = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0, 5))
WAYS = st.tuples(st.lists(PLACES, min_size=1, max_size=5), st.floats(0.05, 20.0))


@settings(max_examples=60)
@given(
    ways=st.tuples(WAYS, WAYS, WAYS, WAYS),
    transmitters=st.sets(st.sampled_from(["c", "d"])),
    mast=st.booleans(),
    bound_m=st.floats(0.002, 0.5),
    extrapolates=st.booleans(),
    period_ns=st.integers(STEP_NS // 3, 90 * STEP_NS),
    pauses_ns=st.lists(st.integers(1, END_NS), max_size=4),
)
def test_no_place_that_counts_is_ever_wrong_by_more_than_the_bound(
    *,
    ways: Sequence[tuple[list[Vector], float]],
    transmitters: set[str],
    mast: bool,
    bound_m: float,
    extrapolates: bool,
    period_ns: int,
    pauses_ns: list[int],
) -> None:
    """The oracle is each way itself, between the steps of the physics at the velocity of the last one."""
    motions = {name: WayPoints(name, *way) for name, way in zip(NAMES, ways, strict=True)}
    network = Spy(extrapolates, sorted(transmitters), [MAST_M] if mast else [])
    agents = Agents(Paths([*motions.values()]), {"a": Periodic("a", "b", period_ns=period_ns)})
    coordinator = Coordinator(agents, network, ErrorBounded(bound_m, 0.2), [("a", "b")])
    try:
        for to_ns in sorted({*pauses_ns, END_NS}):
            coordinator.advance(to_ns)
    except PolicyError:
        fastest_m_s = max(speed_m_s for _, speed_m_s in ways)
        assert not extrapolates, "only agents that stand for the network may be off at once"
        assert 2 * fastest_m_s * STEP_NS / 1e9 > bound_m

    names = ["a", "b", *transmitters]
    assert network.used or not extrapolates
    for at_ns, known in network.used:
        step_ns = at_ns // STEP_NS * STEP_NS
        true_m = {name: _moved_m(motions[name].at(step_ns)[name], at_ns - step_ns) for name in names}
        off_m = [tuple(k - t for k, t in zip(known[name].position_m, true_m[name], strict=True)) for name in names]
        worst_m = max(math.dist(one, other) for one, other in combinations([*off_m, (0.0, 0.0, 0.0)], 2))
        assert worst_m <= bound_m * (1 + 1e-6) + 1e-9, f"at {at_ns} ns"
    for fate in coordinator.run.fates.values():
        assert displaced_m(fate) <= bound_m * (1 + 1e-6) + 1e-9


def _moved_m(state: State, ns: int) -> tuple[float, ...]:
    return tuple(x + v * ns / 1e9 for x, v in zip(state.position_m, state.velocity_m_s, strict=True))


def test_the_host_of_a_ros_1_master_counts_as_it_talks_to_all() -> None:
    simulation = build(load_scenario("field_30ft", {"topology": "masterless"}))
    assert simulation.coordinator.situation.others == ("drone",)


@pytest.mark.parametrize("carries", ["relay", "jammer"])
def test_who_forwards_or_interferes_counts_in_the_bound_and_in_the_reported_errors(carries: str) -> None:
    """A drone that flies between two robots which stand: the robots alone are never wrong about each other."""
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
            if carries == "relay"
            else {"faults": [{"kind": "jammer", "power_dbm": -60, "agent": "drone"}]}
        ),
    }
    scenario = load_scenario("convoy", changes)
    runs = {
        name: build(scenario, policy=policy).run()
        for name, policy in (("bounded", ErrorBounded(0.01)), ("scheduled", Scheduled(0.1)))
    }
    assert max(displaced_m(fate) for fate in runs["bounded"].fates.values()) <= 0.01
    assert len(runs["bounded"].windows_ns) > 60, "the drone accelerates"
    assert errors(runs["bounded"], runs["scheduled"]).position_error_m.largest > 0.1


def test_a_jammer_at_a_fixed_place_counts_where_two_robots_move_side_by_side() -> None:
    """Their distance never changes, but that of both from the jammer does."""
    motions = [WayPoints(name, [(0.0, y, 0.0), (9.0, y, 0.0)], 2.0) for name, y in (("a", 0.0), ("b", 1.0))]
    for fixed_m, worst_m in ((), 0.0), ([MAST_M], 0.2):
        network = Spy(False, (), fixed_m)
        agents = Agents(Paths(motions), {"a": Periodic("a", "b", period_ns=3 * STEP_NS)})
        run = Coordinator(agents, network, Scheduled(0.1), [("a", "b")]).advance(2000 * STEP_NS)
        assert max(map(displaced_m, run.fates.values())) == pytest.approx(worst_m, abs=0.005)


def test_a_bound_that_one_step_of_the_physics_breaks_is_refused_with_a_remedy() -> None:
    physics = Paths(
        [WayPoints("a", [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)], 20.0), WayPoints("b", [(5.0, 0.0, 0.0)], 1)]
    )
    agents = Agents(physics, {"a": Periodic("a", "b", period_ns=STEP_NS)})
    with pytest.raises(PolicyError, match=r"0\.001 s, a and b may be off by 0\.02 m; the bound is 0\.01 m"):
        Coordinator(agents, Disc(100.0, 1), ErrorBounded(0.01), [("a", "b")]).advance(END_NS)
