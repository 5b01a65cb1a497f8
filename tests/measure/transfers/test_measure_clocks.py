"""The line between two clocks compared with the truth for any offset, drift and queues, and with linear programs."""

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.measure.captures.arrays import Floats, Ints
from fieldkit.measure.transfers.clock_offset import MAX_SKEW, QUARTZ_SKEW, STAMP_S, Clocks, StampPairs, estimate
from tests.helpers.nightly import examples

START_NS = 1_700_000_000_000_000_000

offsets_s = st.floats(-3600, 3600)
drifts = st.floats(-100e-6, 100e-6)


class World:
    """Two robots; the receiver's clock is `offset_s` ahead at the start and gains `drift` from then on."""

    def __init__(self, offset_s: float, drift: float) -> None:
        self.offset_s, self.drift = offset_s, drift

    def receiver_ns(self, time_s: Floats) -> Ints:
        ahead_s = self.offset_s + self.drift * time_s
        return self.sender_ns(time_s) + np.floor(ahead_s * 1e9).astype(np.int64)

    @staticmethod
    def sender_ns(time_s: Floats) -> Ints:
        return START_NS + np.floor(time_s * 1e9).astype(np.int64)

    def forward(self, sent_s: Floats, delay_s: Floats) -> StampPairs:
        return _cut(self.sender_ns(sent_s), self.receiver_ns(sent_s + delay_s))

    def reverse(self, sent_s: Floats, delay_s: Floats) -> StampPairs:
        return _cut(self.sender_ns(sent_s + delay_s), self.receiver_ns(sent_s))

    def offset_at_s(self, receiver_ns: Ints) -> Floats:
        """The true offset at times of the receiver's clock."""
        elapsed_s = ((receiver_ns - START_NS) / 1e9 - self.offset_s) / (1 + self.drift)
        truth: Floats = self.offset_s + self.drift * elapsed_s
        return truth


def _cut(sender_ns: Ints, receiver_ns: Ints) -> StampPairs:
    """Truncate times to microseconds as tcpdump does."""
    return StampPairs(sender_ns // 1000 * 1000, receiver_ns // 1000 * 1000)


def _ahead_s(clocks: Clocks, receiver_ns: Ints) -> Floats:
    return clocks.base_ns / 1e9 + clocks.offset_at_s(receiver_ns)


@st.composite
def traffic(draw: st.DrawFn, largest: int = 40, smallest: int = 1) -> tuple[Floats, Floats]:
    """Times of sending, and delays with a lower limit and random queues."""
    count = draw(st.integers(smallest, largest))
    sent_s = draw(st.lists(st.floats(0, 60), min_size=count, max_size=count))
    queue_s = draw(st.lists(st.floats(0, 2), min_size=count, max_size=count))
    return np.array(sent_s), draw(st.floats(0, 0.1)) + np.array(queue_s)


@given(offsets_s, drifts, traffic(), traffic())
@settings(max_examples=examples(200))
def test_offset_and_skew_are_within_their_errors(
    offset_s: float, drift: float, forward_delays: tuple[Floats, Floats], back: tuple[Floats, Floats]
) -> None:
    world = World(offset_s, drift)
    forward, reverse = world.forward(*forward_delays), world.reverse(*back)
    clocks = estimate(forward, reverse)
    assert clocks is not None, "the truth is a line that is possible"
    times = np.concatenate((forward.receiver_ns, reverse.receiver_ns))
    for some in (times, np.array([clocks.middle_ns])):
        wrong_s = np.abs(_ahead_s(clocks, some) - world.offset_at_s(some))
        assert wrong_s.max() <= clocks.error_s(some) + 1e-9
    assert abs(clocks.skew - drift / (1 + drift)) <= clocks.skew_error + 1e-12


@given(offsets_s, drifts, traffic(7, smallest=2), traffic(7, smallest=2))
@settings(max_examples=30, deadline=None)
def test_the_error_is_that_of_linear_programs_that_each_leave_out_one_packet(
    offset_s: float, drift: float, forward_delays: tuple[Floats, Floats], back: tuple[Floats, Floats]
) -> None:
    """The farthest line that is possible without one of the packets has the distance of the error."""
    world = World(offset_s, drift)
    forward, reverse = world.forward(*forward_delays), world.reverse(*back)
    clocks = estimate(forward, reverse)
    assert clocks is not None
    at_ns = np.array([forward.receiver_ns.min()])
    middle_ns, base_ns = clocks.middle_ns, clocks.base_ns

    rows = [
        (sign * np.array([1.0, (int(when) - middle_ns) / 1e9]), sign * (int(ahead) - base_ns) / 1e9 + STAMP_S)
        for sign, delays in ((1, forward), (-1, reverse))
        for when, ahead in zip(delays.receiver_ns, delays.receiver_ns - delays.sender_ns, strict=True)
    ]
    x = (int(at_ns[0]) - middle_ns) / 1e9
    reach_s = [
        scipy.optimize.linprog(
            [sign, sign * x],
            A_ub=np.array([row for row, _ in rows[:left_out] + rows[left_out + 1 :]]),
            b_ub=np.array([bound for _, bound in rows[:left_out] + rows[left_out + 1 :]]),
            bounds=[(None, None), (-MAX_SKEW, MAX_SKEW)],
        ).fun
        * sign
        for sign in (1, -1)
        for left_out in range(len(rows))
    ]
    best_s = float(clocks.offset_at_s(at_ns)[0])
    assert clocks.error_s(at_ns) == pytest.approx(max(best_s - min(reach_s), max(reach_s) - best_s), abs=1e-6)


@given(offsets_s, drifts, traffic(smallest=2), traffic(smallest=2), st.data())
@settings(max_examples=examples(300), deadline=None)
def test_the_truth_is_within_the_error_with_one_wrong_time_of_any_size(
    offset_s: float,
    drift: float,
    forward_delays: tuple[Floats, Floats],
    back: tuple[Floats, Floats],
    data: st.DataObject,
) -> None:
    world = World(offset_s, drift)
    forward, reverse = world.forward(*forward_delays), world.reverse(*back)
    changed = data.draw(st.sampled_from([stamps for pairs in (forward, reverse) for stamps in _stamps(pairs)]))
    index = data.draw(st.integers(0, len(changed) - 1))
    changed[index] += data.draw(st.integers(-5_000, 5_000) | st.integers(-100_000, 100_000)) * 1000
    clocks = estimate(forward, reverse)
    if clocks is None:
        return  # withheld, as if a clock was set
    times_ns = np.concatenate((forward.receiver_ns, reverse.receiver_ns))
    for some_ns in (times_ns, np.array([clocks.middle_ns])):
        wrong_s = np.abs(_ahead_s(clocks, some_ns) - world.offset_at_s(some_ns))
        assert wrong_s.max() <= clocks.error_s(some_ns) + 1e-9
    assert abs(clocks.skew - drift / (1 + drift)) <= clocks.skew_error + 1e-12


def _stamps(pairs: StampPairs) -> tuple[Ints, Ints]:
    return pairs.sender_ns, pairs.receiver_ns


@pytest.mark.parametrize("wrong_ns", [-4_000_000, -100_000, 100_000, 4_000_000])
@pytest.mark.parametrize("direction", range(2))
@pytest.mark.parametrize("end", range(2))
def test_one_wrong_time_neither_shifts_the_offset_nor_narrows_its_error(
    direction: int, end: int, wrong_ns: int
) -> None:
    """Half of a round trip of 10 ms, and 5 ms of drift in the 10 s from the middle to either end."""
    world = World(3.0, 0.0)
    sent_s, delay_s = np.linspace(0, 20, 21), np.full(21, 0.005)
    delays = world.forward(sent_s, delay_s), world.reverse(sent_s, delay_s)
    _stamps(delays[direction])[end][10] += wrong_ns
    clocks = estimate(*delays)
    assert clocks is not None
    at_ns = delays[0].receiver_ns
    assert np.abs(_ahead_s(clocks, at_ns) - 3.0).max() <= 2e-6
    assert clocks.error_s(np.array([clocks.middle_ns])) >= 0.005


@given(st.lists(st.floats(0.001, 0.1), min_size=2, max_size=30), st.lists(st.floats(0.001, 0.1), min_size=2))
def test_without_wrong_times_the_error_is_half_of_the_second_fastest_round_trip(
    there_s: list[float], back_s: list[float]
) -> None:
    """All packets arrive simultaneously, so that drift has no effect: the second smallest delays are the bounds."""
    world = World(-7.0, 0.0)
    forward, reverse = (
        world.forward(1 - np.array(there_s), np.array(there_s)),
        world.reverse(np.ones(len(back_s)), np.array(back_s)),
    )
    clocks = estimate(forward, reverse)
    assert clocks is not None
    above_s, below_s = sorted(there_s)[1], sorted(back_s)[1]
    at_ns = np.array([clocks.middle_ns])
    assert clocks.error_s(at_ns) == pytest.approx((above_s + below_s) / 2, abs=5e-6)
    assert _ahead_s(clocks, at_ns)[0] + 7.0 == pytest.approx((above_s - below_s) / 2, abs=5e-6)


@pytest.mark.parametrize(("count", "growth"), [(20, 0.25), (1000, 0.02)])
def test_without_wrong_times_the_error_of_a_queue_grows_little(count: int, growth: float) -> None:
    """Poisson arrivals and exponential delays: each direction's second smallest of n is 1 / (n - 1) of a mean later.

    `growth` is the permitted increase relative to half of the fastest round trip with the drift that the packets
    leave undetermined, which is the error if no time stamp can be wrong.
    """
    random = np.random.default_rng(5)
    ratios = []
    for _ in range(20):
        world = World(0.5, float(random.uniform(-5e-5, 5e-5)))
        forward, reverse = (
            send(np.sort(random.uniform(0, 10, count)), 0.002 + random.exponential(0.005, count))
            for send in (world.forward, world.reverse)
        )
        clocks = estimate(forward, reverse)
        assert clocks is not None
        at_ns = np.array([clocks.middle_ns])
        fit = _farthest_lines_s(forward, reverse, clocks.middle_ns)
        ratios.append(clocks.error_s(at_ns) / ((fit[1] - fit[0]) / 2))
    assert 1 <= np.median(ratios) <= 1 + growth


def _farthest_lines_s(forward: StampPairs, reverse: StampPairs, at_ns: int) -> tuple[float, float]:
    """Lowest and highest offset of the lines that fit all packets, relative to the first forward packet's."""
    base_ns = int(forward.receiver_ns[0] - forward.sender_ns[0])
    sides = [
        (sign, (delays.receiver_ns - at_ns) / 1e9, (delays.receiver_ns - delays.sender_ns - base_ns) / 1e9)
        for sign, delays in ((1, forward), (-1, reverse))
    ]
    rows = np.concatenate([sign * np.stack((np.ones_like(x), x), axis=1) for sign, x, _ in sides])
    limits = np.concatenate([sign * y + STAMP_S for sign, _, y in sides])
    lowest, highest = (
        sign
        * scipy.optimize.linprog(
            [sign, 0.0], A_ub=rows, b_ub=limits, bounds=[(None, None), (-MAX_SKEW, MAX_SKEW)]
        ).fun
        for sign in (1, -1)
    )
    return float(lowest), float(highest)


def test_without_queues_the_skew_is_exact_and_the_error_is_half_a_round_trip() -> None:
    world = World(-12.5, 40e-6)
    random = np.random.default_rng(4)
    sent_s = np.sort(random.uniform(0, 200, 3000))
    # Every tenth packet has no queuing delay.
    queue_s = np.where(random.random(3000) < 0.1, 0, random.exponential(0.05, 3000))
    clocks = estimate(world.forward(sent_s, 0.004 + queue_s), world.reverse(sent_s, 0.006 + queue_s[::-1]))
    assert clocks is not None
    assert 1e6 * clocks.skew == pytest.approx(40, abs=1)
    middle = np.array([clocks.middle_ns])
    assert clocks.error_s(middle) == pytest.approx(0.005, abs=0.0005)
    # The delays of the directions differ by 2 ms, which captures cannot show: the estimate is wrong by half of that.
    assert world.offset_at_s(middle)[0] - _ahead_s(clocks, middle)[0] == pytest.approx(0.001, abs=0.0001)


def test_a_growing_queue_is_not_mistaken_for_drift() -> None:
    """Moon's one-way hull would take a buffer that fills up for a fast clock; packets in reverse contradict it."""
    world = World(0.25, 0.0)
    sent_s = np.linspace(0, 200, 500)
    clocks = estimate(world.forward(sent_s, 0.003 + 60e-6 * sent_s), world.reverse(sent_s, np.full(500, 0.003)))
    assert clocks is not None
    assert clocks.skew_error < QUARTZ_SKEW
    assert clocks.skew == pytest.approx(0, abs=1e-6)


def test_two_round_trips_give_an_offset_but_no_skew() -> None:
    world = World(7.0, 0.0)
    delay_s = np.full(2, 0.01)
    clocks = estimate(world.forward(np.array([0.0, 0.04]), delay_s), world.reverse(np.array([0.02, 0.06]), delay_s))
    assert clocks is not None
    assert (clocks.skew, clocks.skew_error) == (0.0, MAX_SKEW)
    assert clocks.error_s(np.array([clocks.middle_ns])) == pytest.approx(0.01, abs=4e-5)


@pytest.mark.parametrize("counts", [(1, 1), (1, 9), (9, 1)])
def test_a_single_packet_of_a_direction_is_confirmed_by_no_other(counts: tuple[int, int]) -> None:
    world = World(7.0, 0.0)
    sides = [
        send(np.linspace(0, 1, count), np.full(count, 0.01))
        for send, count in zip((world.forward, world.reverse), counts, strict=True)
    ]
    clocks = estimate(*sides)
    assert clocks is not None, "no clock was set"
    assert clocks.error_s(np.array([clocks.middle_ns])) == np.inf
    assert _ahead_s(clocks, np.array([clocks.middle_ns]))[0] == pytest.approx(7.0, abs=1e-3)


@pytest.mark.parametrize("step_s", [-1.0, 1.0])
def test_a_clock_that_is_set_during_the_capture_fits_no_line(step_s: float) -> None:
    before, after = World(0.0, 0.0), World(step_s, 0.0)
    early, late, delay = np.array([0.0]), np.array([1.0]), np.array([0.01])
    sides = [
        StampPairs.concatenated((before_part, after_part))
        for before_part, after_part in (
            (before.forward(early, delay), after.forward(late, delay)),
            (before.reverse(early, delay), after.reverse(late, delay)),
        )
    ]
    assert estimate(*sides) is None


def test_clocks_decades_apart_lose_no_precision() -> None:
    """A robot without a battery-backed clock starts in 1970."""
    world = World(-1.7e9, 0.0)
    sent_s, delay_s = np.linspace(0, 1, 9), np.full(9, 0.0005)
    forward = world.forward(sent_s, delay_s)
    clocks = estimate(forward, world.reverse(sent_s, delay_s))
    assert clocks is not None
    delays_s = (forward.receiver_ns - forward.sender_ns - clocks.base_ns) / 1e9 - clocks.offset_at_s(
        forward.receiver_ns
    )
    assert delays_s == pytest.approx(delay_s, abs=2e-6)


@given(st.integers(1, 5000), st.integers(0, 2**32))
@settings(max_examples=20)
def test_with_many_packets_a_sample_is_used_and_the_truth_stays_possible(count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    world = World(float(random.uniform(-3600, 3600)), float(random.uniform(-1e-4, 1e-4)))
    sent_s = np.sort(random.uniform(0, 100, count))
    forward = world.forward(sent_s, random.exponential(0.02, count))
    clocks = estimate(forward, world.reverse(sent_s, random.exponential(0.02, count)))
    assert clocks is not None
    wrong_s = np.abs(_ahead_s(clocks, forward.receiver_ns) - world.offset_at_s(forward.receiver_ns))
    assert wrong_s.max() <= clocks.error_s(forward.receiver_ns) + 1e-9
