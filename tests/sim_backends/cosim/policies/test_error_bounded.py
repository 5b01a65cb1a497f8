"""The bound of `error_bounded` on positions, in complete runs with acceleration and collisions, and on path loss."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Action
from sim_backends.cosim.packet_ledger import position_error_m
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import PolicyError, Situation
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.robot_limits import HUSKY_A200
from sim_backends.world.motion import STILL, State
from tests.helpers.worlds import world

STEP_NS = 1_000_000
EXPONENT = 2.5


YARD = world(
    {"name": "wall", "kind": "wall", "from_m": (3, -4), "to_m": (3, 4), "thickness": "0.1m"},
    {"name": "oak", "kind": "tree", "at_m": (0, 3), "trunk_radius": "0.3m"},
    {"name": "box", "kind": "box", "centre_m": (-3, 0), "size_m": (1, 1, 1), "yaw_deg": 30},
)
END_NS = 1_200_000_000


class Driver:
    """A program that drives by a list of twists, each for 0.2 s, and publishes, by default at every physics step."""

    def __init__(self, peer: str, twists: Sequence[Twist], period_ns: int = STEP_NS) -> None:
        self._peer, self._twists, self._period_ns = peer, twists, period_ns
        self._steps = self._number = 0

    def next_wake_ns(self) -> int:
        return min(self._steps * STEP_NS, self.next_send_ns())

    def next_send_ns(self) -> int:
        return self._number * self._period_ns

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self._steps = now_ns // STEP_NS + 1
        command = self._twists[now_ns // 200_000_000 % len(self._twists)]
        if now_ns < self.next_send_ns():
            return Action(command=command)
        datagram = Datagram(self._peer, 10, f"to {self._peer}", self._number)
        self._number += 1
        return Action((datagram,), command)


TWISTS = st.lists(st.builds(Twist, st.floats(-1, 1), st.floats(-2, 2)), min_size=1, max_size=6)


@settings(max_examples=12)
@given(TWISTS, TWISTS, st.floats(0.002, 0.3), st.booleans(), st.integers(STEP_NS, 100 * STEP_NS))
def test_no_error_exceeds_the_bound_in_any_motion_or_collision(
    a_twists: Sequence[Twist], b_twists: Sequence[Twist], bound_m: float, extrapolates: bool, period_ns: int
) -> None:
    bodies = Bodies(
        {"a": DifferentialDrive(HUSKY_A200, (-1.0, 0.0)), "b": DifferentialDrive(HUSKY_A200, (1.0, 0.5), math.pi)},
        YARD,
    )
    agents = Agents(bodies, {"a": Driver("b", a_twists), "b": Driver("a", b_twists, period_ns)})
    policy = ErrorBounded(bound_m, longest_s=1.0)
    network = Disc(100.0, STEP_NS, extrapolates=extrapolates)
    coordinator = Coordinator(agents, network, policy, [("a", "b"), ("b", "a")])
    try:
        run = coordinator.advance(END_NS)
    except PolicyError:
        assert not extrapolates
        assert bound_m < 2 * 1.0 * 0.001, "one step exceeds the bound"
        return
    assert len(run.fates) == END_NS // STEP_NS + -(-END_NS // period_ns)
    assert max(position_error_m(fate) for fate in run.fates.values()) <= bound_m * (1 + 1e-9)
    assert len(run.windows_ns) < END_NS / STEP_NS, "some windows are longer than a step"


def test_no_error_exceeds_the_bound_if_agents_steer_often_and_send_rarely() -> None:
    """No position is used between packets, so a window may contain any motion; it ends before an agent sends."""
    bodies = Bodies({"a": DifferentialDrive(HUSKY_A200, (0.0, -8.0)), "b": DifferentialDrive(HUSKY_A200, (0.0, 8.0))})
    turns = [Twist(1.0, 2.0), Twist(1.0, -2.0)]
    agents = Agents(bodies, {"a": Driver("b", turns, 700_500_000), "b": Driver("a", [Twist(-1.0)], 700_500_000)})
    run = Coordinator(
        agents, Disc(100.0, STEP_NS, extrapolates=True), ErrorBounded(0.005, 0.5), [("a", "b")]
    ).advance(3 * END_NS)
    assert len(run.fates) == 2 * 6
    assert max(position_error_m(fate) for fate in run.fates.values()) <= 0.005
    assert run.windows_ns[0] < 100 * STEP_NS, "datagrams sent at 0 may be under way, so positions are used"
    assert max(np.diff(run.windows_ns)) == 500 * STEP_NS, "nothing is under way, and nothing is sent until 700 ms"
    assert 700 * STEP_NS in run.windows_ns, "the last step before they send"
    assert len(run.windows_ns) < 60


def test_a_collision_with_a_wall_does_not_exceed_the_bound() -> None:
    """While they drive side by side, their relative position is constant, until one of them stops suddenly."""
    start = {"a": (0.0, -1.0), "b": (0.0, 6.0)}
    bodies = Bodies({name: DifferentialDrive(HUSKY_A200, place_m) for name, place_m in start.items()}, YARD)
    agents = Agents(bodies, {name: Driver(peer, [Twist(1.0)]) for name, peer in ("ab", "ba")})
    run = Coordinator(agents, Disc(100.0, STEP_NS, extrapolates=True), ErrorBounded(0.02, 1.0), [("a", "b")]).advance(
        3 * END_NS
    )
    assert [collision.obstacle for collision in bodies.collisions] == ["wall"]
    assert 0.005 < max(position_error_m(fate) for fate in run.fates.values()) <= 0.02


def test_a_window_continues_while_positions_are_not_used() -> None:
    """At 1 m/s, one step reaches the bound of 1 mm; a window with an event begins at most one step before it."""
    states = {"a": State((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), "b": State((5.0, 0.0, 0.0))}
    limits = dict.fromkeys("ab", 0.0)
    policy = ErrorBounded(0.001, longest_s=0.1)

    def window_end_ns(now_ns: int, wake_ns: int | None, event_ns: int | None) -> int:
        situation = Situation(
            now_ns, states, [("a", "b")], lambda: 0, lambda: event_ns, STEP_NS, limits, next_send_ns=wake_ns
        )
        return policy.next_window(situation)

    assert window_end_ns(0, 40_500_000, None) == 40 * STEP_NS
    assert window_end_ns(0, 90_000_000, 40_500_000) == 40 * STEP_NS
    assert window_end_ns(40 * STEP_NS, 40_500_000, None) == 41 * STEP_NS
    assert window_end_ns(0, None, None) == window_end_ns(0, 10**12, None) == 100 * STEP_NS


def test_a_window_is_extended_until_less_than_a_step_of_the_bound_remains() -> None:
    """With an error rate of 1 m/s and a bound of 10 mm, the window may continue for the rest of the bound."""
    states = {"a": State((0.0, 0.0, 0.0)), "b": State((5.0, 0.0, 0.0), (1.0, 0.0, 0.0))}
    limits = dict.fromkeys("ab", 0.0)
    initial_situation = Situation(0, states, [("a", "b")], lambda: 0, lambda: None, STEP_NS, limits, 0, states)
    policy = ErrorBounded(0.01, longest_s=0.1)
    assert policy.next_window(initial_situation) == 100 * STEP_NS, "at a constant velocity there is no error"

    def extended_ns(error_m: float, sends_ns: int = 0) -> int:
        assumed_states = states | {"b": State((5.0 - error_m, 0.0, 0.0))}
        now_ns = 30 * STEP_NS
        situation = replace(
            initial_situation, now_ns=now_ns, assumed_states=assumed_states, next_send_ns=max(sends_ns, now_ns)
        )
        return policy.extended_end_ns(situation)

    assert extended_ns(0.0) == extended_ns(0.0, 35 * STEP_NS) == 40 * STEP_NS
    assert extended_ns(0.0055) == 34 * STEP_NS
    assert extended_ns(0.0095) == extended_ns(0.5) == 30 * STEP_NS
    assert extended_ns(0.5, 34_999_999) == 34 * STEP_NS
    assert extended_ns(0.5, 10**12) == 100 * STEP_NS


def path_loss_db(metres: float) -> float:
    return 10 * EXPONENT * math.log10(max(metres, 1.0))


def window_ns(
    separation_m: float,
    velocity_m_s: tuple[float, float, float],
    bound_db: float,
    assumed_m_s: tuple[float, float, float] = STILL,
) -> int:
    """Return the length of a window in which b moves at another velocity than the network assumes."""
    states = {"a": State((0.0, 0.0, 0.0)), "b": State((separation_m, 0.0, 0.0), velocity_m_s)}
    assumed_states = states | {"b": State((separation_m, 0.0, 0.0), assumed_m_s)}
    limits = dict.fromkeys("ab", 0.0)
    situation = Situation(0, states, [("a", "b")], lambda: 0, lambda: None, STEP_NS, limits, 0, assumed_states)
    return ErrorBounded(longest_s=10.0, bound_db=bound_db, exponent=EXPONENT).next_window(situation)


@given(
    st.floats(0.1, 200.0),
    st.floats(0.0, 10.0),
    st.floats(0.01, 6.0),
    st.floats(-math.pi, math.pi),
    st.floats(-10.0, 10.0),
)
def test_the_path_loss_error_of_a_pair_does_not_exceed_the_bound(
    separation_m: float, speed_m_s: float, bound_db: float, course_rad: float, assumed_m_s: float
) -> None:
    east_m_s, north_m_s = speed_m_s * math.cos(course_rad), speed_m_s * math.sin(course_rad)
    try:
        end_ns = window_ns(separation_m, (east_m_s, north_m_s, 0.0), bound_db, (assumed_m_s, 0.0, 0.0))
    except PolicyError:
        bound_m = max(separation_m, 1.0) * (1 - 10 ** (-bound_db / (10 * EXPONENT)))
        assert math.hypot(east_m_s - assumed_m_s, north_m_s) * 0.001 > bound_m, "one step exceeds the bound"
        return
    if end_ns == STEP_NS:
        return  # states are constant within a window of one step
    true_distance_m = math.hypot(separation_m + east_m_s * end_ns / 1e9, north_m_s * end_ns / 1e9)
    assumed_distance_m = abs(separation_m + assumed_m_s * end_ns / 1e9)
    assert abs(path_loss_db(true_distance_m) - path_loss_db(assumed_distance_m)) <= bound_db * (1 + 1e-9)


def test_a_window_during_a_direct_approach_ends_when_the_error_equals_the_bound() -> None:
    end_ns = window_ns(50.0, (-2.0, 0.0, 0.0), 1.0)
    assert path_loss_db(50.0) - path_loss_db(50.0 - 2.0 * end_ns / 1e9) == pytest.approx(1.0, rel=0.001)


@pytest.mark.parametrize("values", [{"bound_m": 0.0}, {"bound_db": -1.0}, {"exponent": math.nan}])
def test_a_bound_that_is_not_above_0_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(PolicyError, match=r"error_bounded: .* is not a finite number above 0"):
        ErrorBounded(**values)
