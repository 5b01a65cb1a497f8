"""Sync policies compared with results computed by hand: two robots pass each other, with a link of limited range."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.comparison import Spread, compare_runs
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Action, FederateError
from sim_backends.cosim.packet_ledger import position_error_m
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import PolicyError, Situation, SyncPolicy
from sim_backends.cosim.policies.window_policies import (
    EventDriven,
    Scheduled,
    SlidingWindow,
    TimeStepped,
    VariableStepped,
    VelocityAware,
    VelocityAwareRaw,
    Windows,
)
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.run_record import Run
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import STILL, State, WayPoints

MS = 1_000_000
END_NS = 10_000 * MS
FAR_M, ASIDE_M, RANGE_M = 10.0, 1.0, 4.0
PERIOD_NS, DELAY_NS = 3_700_001, 1_234_567


FIXED = [Scheduled, SlidingWindow, TimeStepped]


def passing_run(
    policy: SyncPolicy, *, a_m_s: float = 1.0, b_m_s: float = 0.7, to_ns: int = END_NS, step_ns: int = MS
) -> Run:
    """Let two robots pass each other at a distance of 1 m; one sends to the other."""
    paths = {
        "a": [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)],
        "b": [(FAR_M, ASIDE_M, 0.0), (FAR_M - 100.0, ASIDE_M, 0.0)],
    }
    speeds = {"a": a_m_s, "b": b_m_s}
    physics = Paths([WayPoints(name, path, speeds[name]) for name, path in paths.items()], step_ns=step_ns)
    agents = Agents(physics, {"a": Periodic("a", "b", period_ns=PERIOD_NS)})
    network = Disc(RANGE_M, DELAY_NS, extrapolates=True)
    return Coordinator(agents, network, policy, [("a", "b")]).advance(to_ns)


def is_in_range(at_ns: int) -> bool:
    at_s = at_ns // MS / 1000
    return math.hypot(FAR_M - 1.7 * at_s, ASIDE_M) <= RANGE_M


def window_begin(window_ns: int) -> Callable[[int], int]:
    return lambda at_ns: at_ns // window_ns * window_ns


def window_end(window_ns: int) -> Callable[[int], int]:
    return lambda at_ns: (at_ns // window_ns + 1) * window_ns


def closed_window_end(window_ns: int) -> Callable[[int], int]:
    return lambda at_ns: max(-(-at_ns // window_ns), 1) * window_ns


def same_time(at_ns: int) -> int:
    return at_ns


@dataclass(frozen=True)
class ExpectedTimes:
    """A policy, and the times that it determines for a packet, as functions.

    Attributes:
        policy: The policy.
        enters: Returns the time when a packet enters the network from the time when it was sent.
        assumes: Returns the time of the assumed states from the time when the packet enters.
        counts: Returns the time from which an arrival counts from the time of the arrival.
    """

    policy: SyncPolicy
    enters: Callable[[int], int] = same_time
    assumes: Callable[[int], int] = same_time
    counts: Callable[[int], int] = same_time


W_NS = 1_100_000
EXPECTATIONS = [
    ExpectedTimes(EventDriven()),
    ExpectedTimes(VariableStepped()),
    ExpectedTimes(TimeStepped(0.0011), enters=window_end(W_NS), counts=window_end(W_NS)),
    ExpectedTimes(Scheduled(0.0011), assumes=window_begin(W_NS), counts=window_end(W_NS)),
    ExpectedTimes(SlidingWindow(0.0011), assumes=closed_window_end(W_NS)),
    ExpectedTimes(SlidingWindow(0.25), assumes=closed_window_end(250 * MS)),
    # 1 ms, and 0.3 ms because the publisher is faster by 0.3 m/s.
    ExpectedTimes(VelocityAwareRaw(0.001), assumes=closed_window_end(1_300_000)),
    # 1 ms, and 1.7 ms because of the relative velocity of 1.7 m/s.
    ExpectedTimes(VelocityAware(0.001), assumes=closed_window_end(2_700_000)),
    # At constant velocities the extrapolation is exact, so the window has its maximum length.
    ExpectedTimes(ErrorBounded(0.1), counts=window_end(100 * MS)),
]


@pytest.mark.parametrize("expected", EXPECTATIONS, ids=lambda expected: expected.policy.name)
def test_fates_and_times_equal_values_computed_by_hand(expected: ExpectedTimes) -> None:
    run = passing_run(expected.policy)
    assert len(run.fates) == -(-END_NS // PERIOD_NS)
    lost_count = 0
    for (flow, number), fate in run.fates.items():
        sent_ns = number * PERIOD_NS
        enters_ns = expected.enters(sent_ns)
        arrives_ns = enters_ns + DELAY_NS
        assert (flow, fate.packet.sent_ns, fate.packet.enters_ns) == ("a", sent_ns, enters_ns)
        if not is_in_range(expected.assumes(enters_ns)):
            assert (fate.reason, fate.arrived_ns) == ("out of range", None)
            lost_count += 1
        elif fate.arrived_ns is None:
            assert arrives_ns > END_NS - 250 * MS, "under way at the end"
        else:
            assert fate.arrived_ns == arrives_ns
            assert fate.counted_ns == expected.counts(arrives_ns)
    assert lost_count > 100


def test_exact_policies_agree_in_each_packet_and_only_sliding_windows_are_late() -> None:
    reference, variable_run = passing_run(EventDriven()), passing_run(VariableStepped())
    for identity, fate in reference.fates.items():
        other = variable_run.fates[identity]
        assert (fate.arrived_ns, fate.reason, fate.assumed_states) == (
            other.arrived_ns,
            other.reason,
            other.assumed_states,
        )
        hold_error_m = 1.7 * (fate.packet.sent_ns % MS) / 1e9
        assert position_error_m(fate) == pytest.approx(hold_error_m, abs=1e-9), "states are held for a step"
        assert not fate.late_ns
    assert any(fate.late_ns for fate in passing_run(SlidingWindow(0.05)).fates.values()), (
        "some receivers had already passed the time of arrival"
    )
    assert not any(fate.late_ns for fate in passing_run(Scheduled(0.05)).fates.values())


def policies_with(kind: Callable[[float], SyncPolicy]) -> st.SearchStrategy[Callable[[], SyncPolicy]]:
    """Return a strategy for functions that make a policy with a random window in seconds, or bound in metres."""
    return st.floats(0.001, 0.3).map(lambda value: partial(kind, value))


POLICIES: st.SearchStrategy[Callable[[], SyncPolicy]] = st.one_of(
    st.just(EventDriven),
    st.just(VariableStepped),
    *(policies_with(kind) for kind in (TimeStepped, Scheduled, SlidingWindow, VelocityAware)),
    policies_with(ErrorBounded),
)


@given(POLICIES, st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_packets_arrive_after_they_were_sent_and_equal_runs_have_equal_digests(
    make_sync_policy: Callable[[], SyncPolicy], a_m_s: float, b_m_s: float
) -> None:
    policy = make_sync_policy()
    a_m_s, b_m_s = max(a_m_s, 0.01), max(b_m_s, 0.01)
    run = passing_run(policy, a_m_s=a_m_s, b_m_s=b_m_s, to_ns=1000 * MS)
    assert passing_run(make_sync_policy(), a_m_s=a_m_s, b_m_s=b_m_s, to_ns=1000 * MS).digest == run.digest
    assert run.windows_ns == sorted(run.windows_ns)
    assert run.windows_ns[-1] == 1000 * MS
    if not policy.exact:
        assert all(later - earlier >= MS for earlier, later in pairwise([0, *run.windows_ns[:-1]]))
    for fate in run.fates.values():
        assert fate.packet.enters_ns >= fate.packet.sent_ns
        if fate.arrived_ns is not None and fate.counted_ns is not None:
            assert fate.counted_ns >= fate.arrived_ns == fate.packet.enters_ns + DELAY_NS


@given(st.floats(1e6, 1e8), st.integers(0, 10**12))
def test_windows_of_any_length_do_not_drift(length_ns: float, begin_ns: int) -> None:
    windows, now_ns = Windows(), begin_ns
    for _ in range(1000):
        now_ns = windows.end_ns(now_ns, length_ns)
    # The rounding error of each of the thousand windows is at most half an attosecond.
    assert abs(now_ns - begin_ns - 1000 * Fraction(length_ns)) < 1


def test_a_million_windows_end_at_a_million_times_their_length() -> None:
    windows, now_ns = Windows(), 0
    for _ in range(10**6):
        now_ns = windows.end_ns(now_ns, 1_100_000 + 1 / 3)
    assert abs(now_ns - 10**6 * Fraction(1_100_000 + 1 / 3)) < 1


def test_errors_equal_those_computed_by_hand() -> None:
    """Packets are sent at all phases of a window, so waiting for its end takes half a window on average."""
    reference, window_s = passing_run(EventDriven()), 0.05
    exact_errors = compare_runs(reference, passing_run(VariableStepped()))
    assert exact_errors.delivery_error_s == Spread(0, 0, 0)
    assert exact_errors.position_error_m.mean == pytest.approx(1.7 * 0.001 / 2, rel=0.12), "states are held for 1 ms"
    assert exact_errors.position_error_m.largest <= 1.7 * 0.001
    assert (exact_errors.fate_disagreement, exact_errors.first_disagreement, exact_errors.causality_violations) == (
        0,
        None,
        0,
    )
    scheduled_errors = compare_runs(reference, passing_run(Scheduled(window_s)))
    assert scheduled_errors.delivery_error_s.mean == pytest.approx(window_s / 2, rel=0.01)
    assert scheduled_errors.delivery_error_s.largest == pytest.approx(window_s, rel=0.01)
    assert scheduled_errors.delay_added_s == pytest.approx(window_s / 2, rel=0.01)
    assert scheduled_errors.exchanges_per_s == pytest.approx(1 / window_s)
    assert scheduled_errors.causality_violations == 0
    # Their relative speed is 1.7 m/s; the states are those at the beginning of the window.
    assert scheduled_errors.position_error_m.largest == pytest.approx(1.7 * window_s, rel=0.03)
    assert scheduled_errors.position_error_m.mean == pytest.approx(1.7 * window_s / 2, rel=0.02)
    # Packets have another fate only in windows in which the robots enter or leave the range.
    differing_packets = scheduled_errors.fate_disagreement * scheduled_errors.packets
    assert 1 <= differing_packets <= 2 * window_s * 1e9 / PERIOD_NS + 2
    assert scheduled_errors.first_disagreement is not None
    sliding_errors = compare_runs(reference, passing_run(SlidingWindow(window_s)))
    assert sliding_errors.delivery_error_s == Spread(0, 0, 0), "arrivals keep their time"
    assert sliding_errors.position_error_m.mean == pytest.approx(1.7 * window_s / 2, rel=0.02)
    assert sliding_errors.causality_violations > 0.9 * sum(not fate.reason for fate in reference.fates.values())
    stepped_errors = compare_runs(reference, passing_run(TimeStepped(window_s)))
    # Packets wait for half a window before the network. They enter it at the beginning of a window, arrive after the
    # delay of the link, and wait for the rest of that window.
    assert stepped_errors.delay_added_s == pytest.approx(1.5 * window_s - DELAY_NS / 1e9, rel=0.01)


@pytest.mark.parametrize("step_ns", [5 * MS, 10 * MS], ids=["half the window", "the window"])
@pytest.mark.parametrize(("policy", "window_s"), [*((kind, 0.01) for kind in FIXED), (lambda _: EventDriven(), None)])
def test_position_errors_are_half_a_window_for_any_step_of_the_physics(
    policy: Callable[[float], SyncPolicy], window_s: float | None, step_ns: int
) -> None:
    """All fixed windows have the same error; the exact policy has an error of half a step."""
    error_m = compare_runs(passing_run(EventDriven()), passing_run(policy(0.01), step_ns=step_ns)).position_error_m
    hold_time_s = step_ns / 1e9 if window_s is None else window_s
    assert error_m.mean == pytest.approx(1.7 * hold_time_s / 2, rel=0.02)
    assert error_m.largest == pytest.approx(1.7 * hold_time_s, rel=0.02)


@pytest.mark.parametrize("policy", FIXED)
def test_windows_of_half_the_length_have_half_the_error(
    policy: type[Scheduled | SlidingWindow | TimeStepped],
) -> None:
    """All fixed windows are of the first order, in time or in space."""
    reference = passing_run(EventDriven())
    errors_of_long_windows, errors_of_short_windows = (
        compare_runs(reference, passing_run(policy(window_s))) for window_s in (0.08, 0.04)
    )
    orders = [
        math.log2(coarse_error / fine_error)
        for coarse_error, fine_error in (
            (errors_of_long_windows.delivery_error_s.mean, errors_of_short_windows.delivery_error_s.mean),
            (errors_of_long_windows.position_error_m.mean, errors_of_short_windows.position_error_m.mean),
        )
        if coarse_error
    ]
    assert orders
    assert orders == pytest.approx([1.0] * len(orders), abs=0.1)


@pytest.mark.parametrize(("subscriber_m_s", "effect"), [(2.0, "stops"), (2.5, "runs backwards")])
def test_the_rule_as_printed_fails_if_the_subscriber_is_faster(subscriber_m_s: float, effect: str) -> None:
    with pytest.raises(PolicyError, match=rf"a publishes at 1 m/s to b at {subscriber_m_s:g} m/s.*time {effect}"):
        passing_run(VelocityAwareRaw(0.001), a_m_s=1.0, b_m_s=subscriber_m_s)
    # If the speeds are exchanged, the same pair has a window of at least 2 ms.
    assert passing_run(VelocityAwareRaw(0.001), a_m_s=subscriber_m_s, b_m_s=1.0, to_ns=100 * MS).fates


@pytest.mark.parametrize("window_s", [0.0, -1.0, math.inf, math.nan])
def test_a_window_that_is_not_a_positive_time_is_refused(window_s: float) -> None:
    for kind in (TimeStepped, Scheduled, SlidingWindow):
        with pytest.raises(PolicyError, match="not a positive time"):
            kind(window_s)


def test_a_window_below_the_physics_step_is_refused() -> None:
    with pytest.raises(PolicyError, match="physics step, 1000000 ns"):
        passing_run(SlidingWindow(0.0005))


SPEEDS = st.floats(-3, 3)
STATES = st.tuples(SPEEDS, SPEEDS, SPEEDS).map(lambda velocity: State((0.0, 0.0, 0.0), velocity))


@given(
    st.lists(STATES, min_size=2, max_size=5), st.floats(0.002, 2), st.floats(0, 5), st.floats(-1, 1), st.booleans()
)
def test_error_bounded_satisfies_its_bound_for_any_motion_within_the_limits(
    states: Sequence[State], bound_m: float, limit_m_s2: float, share: float, assumes_motion: bool
) -> None:
    names = [f"r{number}" for number in range(len(states))]
    pairs = [(publisher, subscriber) for publisher in names for subscriber in names if publisher != subscriber]
    situation = Situation(
        7 * MS,
        dict(zip(names, states, strict=True)),
        pairs,
        lambda: 7 * MS,
        lambda: None,
        MS,
        dict.fromkeys(names, limit_m_s2),
        7 * MS,
    )
    if assumes_motion:
        situation.assumed_states = situation.states
    try:
        end_ns = ErrorBounded(bound_m, 100.0).next_window(situation)
    except PolicyError:
        # The motion in one step may exceed the bound.
        speeds_m_s = [math.dist(a.velocity_m_s, b.velocity_m_s) for a in [*states, State(STILL)] for b in states]
        assert not assumes_motion
        assert max(speeds_m_s) * 0.001 > bound_m
        return
    window_s = (end_ns - 7 * MS) / 1e9
    assert (end_ns - 7 * MS) % MS == 0
    if end_ns == 8 * MS:
        return  # states are constant within a window of one step
    for publisher, subscriber in pairs:
        velocities = (situation.states[name].velocity_m_s for name in (publisher, subscriber))
        v = [a - b for a, b in zip(*velocities, strict=True)]
        # Both accelerate at their limit in opposite directions, along or against their relative velocity.
        speed_m_s = math.hypot(*v)
        error_m = (0 if assumes_motion else speed_m_s * window_s) + share * limit_m_s2 * window_s**2
        assert abs(error_m) <= bound_m * (1 + 1e-9)


class ReplyingProgram:
    """A program that replies immediately to the first `times` datagrams."""

    def __init__(self, peer: str, times: int, *, begins: bool) -> None:
        self._peer, self._remaining, self._begins = peer, times, begins
        self.received_ns: list[int] = []

    def next_wake_ns(self) -> int | None:
        return 0 if self._begins else None

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self._begins = False
        self.received_ns += [now_ns for _ in received]
        self._remaining -= 1
        if self._remaining < 0:
            return Action()
        return Action((Datagram(self._peer, 10, f"to {self._peer}", self._remaining, None),))


@pytest.mark.parametrize(
    ("policy", "round_ns"),
    [
        (EventDriven(), 2 * DELAY_NS),
        (VariableStepped(), 2 * DELAY_NS),
        # In each direction a datagram waits for the end of a window of 5 ms.
        (Scheduled(0.005), 2 * 5 * MS),
        # In addition, each datagram waits for the end of a window before it enters.
        (TimeStepped(0.005), 2 * 10 * MS),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_round_trips_of_immediate_replies_have_the_delay_of_the_policy(policy: SyncPolicy, round_ns: int) -> None:
    requester, responder = ReplyingProgram("b", 5, begins=True), ReplyingProgram("a", 5, begins=False)
    physics = Paths([WayPoints(name, [(0.0, 0.0, 0.0)], 1.0) for name in "ab"])
    agents = Agents(physics, {"a": requester, "b": responder})
    Coordinator(agents, Disc(1.0, DELAY_NS), policy, [("a", "b")]).advance(END_NS)
    assert requester.received_ns[:4] == [round_ns * number for number in range(1, 5)]


class EndlessWakes:
    """A program that wakes endlessly at one instant."""

    def next_wake_ns(self) -> int:
        return 5

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        return Action()


def test_a_program_that_wakes_endlessly_is_named() -> None:
    physics = Paths([WayPoints("a", [(0.0, 0.0, 0.0)], 1.0)])
    with pytest.raises(FederateError, match=r"1001 times at 0\.000000005 s, most recently the program of a"):
        Coordinator(Agents(physics, {"a": EndlessWakes()}), Disc(1.0, 1), EventDriven(), []).advance(10)
