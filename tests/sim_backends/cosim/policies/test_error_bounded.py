"""The bound of `error_bounded`: in whole runs of bodies that accelerate and run into things, and in decibel."""

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
from sim_backends.cosim.geometry import displaced_m
from sim_backends.cosim.policies.base import PolicyError, Situation
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Datagram, Received
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import HUSKY_A200, DifferentialDrive
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
    """Drives by a list of twists, one each 0.2 s, and publishes, by default at every step of the physics."""

    def __init__(self, peer: str, twists: Sequence[Twist], period_ns: int = STEP_NS) -> None:
        self._peer, self._twists, self._period_ns = peer, twists, period_ns
        self._steps = self._number = 0

    def next_wake_ns(self) -> int:
        return min(self._steps * STEP_NS, self.next_send_ns())

    def next_send_ns(self) -> int:
        return self._number * self._period_ns

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
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
def test_the_bound_holds_in_every_run_whatever_bodies_do_and_run_into(
    one: Sequence[Twist], other: Sequence[Twist], bound_m: float, extrapolates: bool, period_ns: int
) -> None:
    bodies = Bodies(
        {"a": DifferentialDrive(HUSKY_A200, (-1.0, 0.0)), "b": DifferentialDrive(HUSKY_A200, (1.0, 0.5), math.pi)},
        YARD,
    )
    agents = Agents(bodies, {"a": Driver("b", one), "b": Driver("a", other, period_ns)})
    policy = ErrorBounded(bound_m, longest_s=1.0)
    network = Disc(100.0, STEP_NS, extrapolates=extrapolates)
    coordinator = Coordinator(agents, network, policy, [("a", "b"), ("b", "a")])
    try:
        run = coordinator.advance(END_NS)
    except PolicyError:
        assert not extrapolates
        assert bound_m < 2 * 1.0 * 0.001, "one step breaks it"
        return
    assert len(run.fates) == END_NS // STEP_NS + -(-END_NS // period_ns)
    assert max(displaced_m(fate) for fate in run.fates.values()) <= bound_m * (1 + 1e-9)
    assert len(run.windows_ns) < END_NS / STEP_NS, "it takes more than a step where it can"


def test_a_bound_is_kept_where_agents_steer_often_and_send_seldom() -> None:
    """Nobody asks for places while they drive, so that a window goes on over any way, and ends before they send."""
    bodies = Bodies({"a": DifferentialDrive(HUSKY_A200, (0.0, -8.0)), "b": DifferentialDrive(HUSKY_A200, (0.0, 8.0))})
    turns = [Twist(1.0, 2.0), Twist(1.0, -2.0)]
    agents = Agents(bodies, {"a": Driver("b", turns, 700_500_000), "b": Driver("a", [Twist(-1.0)], 700_500_000)})
    run = Coordinator(
        agents, Disc(100.0, STEP_NS, extrapolates=True), ErrorBounded(0.005, 0.5), [("a", "b")]
    ).advance(3 * END_NS)
    assert len(run.fates) == 2 * 6
    assert max(displaced_m(fate) for fate in run.fates.values()) <= 0.005
    assert run.windows_ns[0] < 100 * STEP_NS, "what they sent at 0 may be under way, so that places count"
    assert max(np.diff(run.windows_ns)) == 500 * STEP_NS, "nothing is under way, and nobody sends until 700 ms"
    assert 700 * STEP_NS in run.windows_ns, "the last step before they send"
    assert len(run.windows_ns) < 60


def test_who_runs_into_a_wall_does_not_break_the_bound() -> None:
    """Side by side they do not displace each other, until one of them is stopped at once."""
    start = {"a": (0.0, -1.0), "b": (0.0, 6.0)}
    bodies = Bodies({name: DifferentialDrive(HUSKY_A200, place_m) for name, place_m in start.items()}, YARD)
    agents = Agents(bodies, {name: Driver(peer, [Twist(1.0)]) for name, peer in ("ab", "ba")})
    run = Coordinator(agents, Disc(100.0, STEP_NS, extrapolates=True), ErrorBounded(0.02, 1.0), [("a", "b")]).advance(
        3 * END_NS
    )
    assert [one.obstacle for one in bodies.collisions] == ["wall"]
    assert 0.005 < max(displaced_m(fate) for fate in run.fates.values()) <= 0.02


def test_a_window_goes_on_while_nobody_asks_for_the_geometry() -> None:
    """A bound of 1 mm at 1 m/s is one step; the window in which something happens begins at most one before."""
    states = {"a": State((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), "b": State((5.0, 0.0, 0.0))}
    limits = dict.fromkeys("ab", 0.0)
    policy = ErrorBounded(0.001, longest_s=0.1)

    def ends_ns(now_ns: int, wake_ns: int | None, event_ns: int | None) -> int:
        situation = Situation(
            now_ns, states, [("a", "b")], lambda: 0, lambda: event_ns, STEP_NS, limits, next_send_ns=wake_ns
        )
        return policy.next_window(situation)

    assert ends_ns(0, 40_500_000, None) == 40 * STEP_NS
    assert ends_ns(0, 90_000_000, 40_500_000) == 40 * STEP_NS
    assert ends_ns(40 * STEP_NS, 40_500_000, None) == 41 * STEP_NS
    assert ends_ns(0, None, None) == ends_ns(0, 10**12, None) == 100 * STEP_NS


def test_a_window_goes_on_until_what_was_seen_leaves_less_than_a_step() -> None:
    """A pair that parts at 1 m/s from where it is taken to be, with a bound of 10 mm, may go on for what is left."""
    states = {"a": State((0.0, 0.0, 0.0)), "b": State((5.0, 0.0, 0.0), (1.0, 0.0, 0.0))}
    limits = dict.fromkeys("ab", 0.0)
    begin = Situation(0, states, [("a", "b")], lambda: 0, lambda: None, STEP_NS, limits, 0, states)
    policy = ErrorBounded(0.01, longest_s=0.1)
    assert policy.next_window(begin) == 100 * STEP_NS, "it keeps its velocity"

    def goes_on_ns(off_m: float, sends_ns: int = 0) -> int:
        known = states | {"b": State((5.0 - off_m, 0.0, 0.0))}
        now_ns = 30 * STEP_NS
        return policy.goes_on(replace(begin, now_ns=now_ns, known=known, next_send_ns=max(sends_ns, now_ns)))

    assert goes_on_ns(0.0) == goes_on_ns(0.0, 35 * STEP_NS) == 40 * STEP_NS
    assert goes_on_ns(0.0055) == 34 * STEP_NS
    assert goes_on_ns(0.0095) == goes_on_ns(0.5) == 30 * STEP_NS
    assert goes_on_ns(0.5, 34_999_999) == 34 * STEP_NS
    assert goes_on_ns(0.5, 10**12) == 100 * STEP_NS


def loss_db(metres: float) -> float:
    return 10 * EXPONENT * math.log10(max(metres, 1.0))


def window_ns(
    apart_m: float,
    velocity_m_s: tuple[float, float, float],
    bound_db: float,
    known_m_s: tuple[float, float, float] = STILL,
) -> int:
    """Return how long a window is in which b is taken to move otherwise than it does."""
    states = {"a": State((0.0, 0.0, 0.0)), "b": State((apart_m, 0.0, 0.0), velocity_m_s)}
    known = states | {"b": State((apart_m, 0.0, 0.0), known_m_s)}
    limits = dict.fromkeys("ab", 0.0)
    situation = Situation(0, states, [("a", "b")], lambda: 0, lambda: None, STEP_NS, limits, 0, known)
    return ErrorBounded(longest_s=10.0, bound_db=bound_db, exponent=EXPONENT).next_window(situation)


@given(
    st.floats(0.1, 200.0),
    st.floats(0.0, 10.0),
    st.floats(0.01, 6.0),
    st.floats(-math.pi, math.pi),
    st.floats(-10.0, 10.0),
)
def test_the_loss_of_a_pair_is_wrong_by_no_more_than_the_bound(
    apart_m: float, speed_m_s: float, bound_db: float, course_rad: float, known_m_s: float
) -> None:
    e_m_s, n_m_s = speed_m_s * math.cos(course_rad), speed_m_s * math.sin(course_rad)
    try:
        end_ns = window_ns(apart_m, (e_m_s, n_m_s, 0.0), bound_db, (known_m_s, 0.0, 0.0))
    except PolicyError:
        bound_m = max(apart_m, 1.0) * (1 - 10 ** (-bound_db / (10 * EXPONENT)))
        assert math.hypot(e_m_s - known_m_s, n_m_s) * 0.001 > bound_m, "one step breaks it"
        return
    if end_ns == STEP_NS:
        return  # the window of one step, in which nothing changes
    later_m = math.hypot(apart_m + e_m_s * end_ns / 1e9, n_m_s * end_ns / 1e9)
    known_m = abs(apart_m + known_m_s * end_ns / 1e9)
    assert abs(loss_db(later_m) - loss_db(known_m)) <= bound_db * (1 + 1e-9)


def test_who_comes_straight_nearer_uses_the_whole_bound() -> None:
    end_ns = window_ns(50.0, (-2.0, 0.0, 0.0), 1.0)
    assert loss_db(50.0) - loss_db(50.0 - 2.0 * end_ns / 1e9) == pytest.approx(1.0, rel=0.001)


@pytest.mark.parametrize("values", [{"bound_m": 0.0}, {"bound_db": -1.0}, {"exponent": math.nan}])
def test_a_bound_that_is_not_above_0_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(PolicyError, match=r"error_bounded: .* is not above 0"):
        ErrorBounded(**values)
