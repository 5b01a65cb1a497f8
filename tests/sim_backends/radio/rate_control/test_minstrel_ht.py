"""Minstrel-HT compared with closed forms: the expected mode at a fixed signal, the chain, samples, and failures."""

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config.wifi_phy import WifiAmendment
from sim_backends.radio.core.random_streams import PacketDraws
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import PhyCapability, format_modes, mode_groups
from sim_backends.radio.phy.modes import BandName, WifiMode
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.rate_control.minstrel_ht import MinstrelHt

STEP_NS = 2_000_000
HT20 = format_modes("HT", "2.4 GHz", 20, 1, 800)


def groups(
    amendment: WifiAmendment, band: BandName, width_mhz: int, streams: int, guard_ns: int
) -> Sequence[Sequence[WifiMode]]:
    phy = PhyCapability(amendment, band, width_mhz, streams, guard_ns)
    return mode_groups(phy, phy)


def make_control(*rate_groups: Sequence[WifiMode]) -> MinstrelHt:
    return MinstrelHt(rate_groups, PacketDraws(1, "a", "b"))


def first_modes(
    rate: MinstrelHt,
    aggregates: int,
    share_of: Callable[[WifiMode], float],
    *,
    length: int = 16,
    start: int = 0,
    step_ns: int = STEP_NS,
) -> list[WifiMode]:
    """Return the first mode of each aggregate, one every 2 ms; `share_of` returns the share of received frames."""
    random = Random(start)
    modes = []
    for number in range(start, start + aggregates):
        attempt, acknowledged_frames = 0, 0
        while not acknowledged_frames and attempt < 7:
            attempt += 1
            mode = rate.choose(number * step_ns, ("a", number), attempt)
            modes += [mode] * (attempt == 1)
            frames = 1 if rate.is_probing and attempt == 1 else length
            acknowledged_frames = sum(random.random() < share_of(mode) for _ in range(frames))
            rate.report(mode, acknowledged=acknowledged_frames, frames=frames)
    return modes


@pytest.mark.parametrize("snr_db", [8.0, 20.0, 26.0, 40.0])
@pytest.mark.parametrize(
    "radio",
    [
        ("n", "2.4 GHz", 20, 1, 800),
        ("n", "2.4 GHz", 20, 1, 400),
        ("ac", "5 GHz", 80, 2, 400),
        ("ax", "6 GHz", 20, 2, 800),
    ],
    ids=lambda radio: " ".join(map(str, radio)),
)
def test_at_a_fixed_signal_the_mode_has_the_highest_expected_rate(
    radio: tuple[WifiAmendment, BandName, int, int, int], snr_db: float
) -> None:
    """The rate is a share of at most 90 % over the time of 1200 bytes and a sixteenth of SIFS, headers and ACK."""
    received_shares = {
        mode: 1 - packet_error(mode, snr_db - decibel(mode.noise_factor), 1200)
        for group in groups(*radio)
        for mode in group
    }
    expected_rate = {
        mode: min(share, 0.9) / (108_000 / 16 + 9600 / mode.rate_bit_s * 1e9) * (share >= 0.1)
        for mode, share in received_shares.items()
    }
    modes = first_modes(make_control(*groups(*radio)), 1500, received_shares.__getitem__, step_ns=5_000_000)
    used_mode = Counter(modes[1000:]).most_common(1)[0][0]
    assert expected_rate[used_mode] >= 0.97 * max(expected_rate.values())


def test_the_chain_has_the_two_fastest_modes_and_a_robust_one_with_as_many_tries_as_fit_in_6_ms() -> None:
    """All modes work. 16 frames of 1200 bytes take 2.364 ms at MCS 7, two tries 5.15 ms with backoffs, three 7.9.

    Single frames take 148 us at MCS 7; 5 tries take 3.6 ms with mean backoffs up to 255 slots, 6 tries 6.1 ms.
    """
    rate = make_control(HT20)
    first_modes(rate, 1000, lambda _: 1.0)
    assert [(HT20.index(mode), tries) for mode, tries in rate.stages] == [(7, 2), (6, 2), (7, 2)]
    single_frame_rate = make_control(HT20)
    first_modes(single_frame_rate, 1000, lambda _: 1.0, length=1)
    assert [(HT20.index(mode), tries) for mode, tries in single_frame_rate.stages] == [(7, 5), (6, 5), (7, 5)]


def test_more_than_three_quarters_of_frames_arrive_in_the_robust_mode() -> None:
    received_shares = [1.0, 1.0, 1.0, 1.0, 0.7, 0.4, 0.0, 0.0]
    rate = make_control(HT20)
    first_modes(rate, 3000, lambda mode: received_shares[HT20.index(mode)])
    assert [HT20.index(mode) for mode, _ in rate.stages] == [4, 3, 3]


def test_the_robust_mode_has_one_stream_if_the_fastest_has_two() -> None:
    rate = make_control(*groups("ac", "5 GHz", 80, 2, 400))
    first_modes(rate, 3000, lambda _: 1.0)
    assert [mode.streams for mode, _ in rate.stages] == [2, 2, 1]


def test_a_mode_is_sampled_at_most_every_20_ms_and_once_per_frame() -> None:
    """Modes up to MCS 3 work; faster ones are sampled once per 20 ms, and MCS 3 follows immediately."""
    rate = make_control(HT20)
    first_modes(rate, 500, lambda mode: float(HT20.index(mode) <= 3))
    chains = []
    for number in range(500, 1500):
        chain = [rate.choose(number * STEP_NS, ("a", number), attempt) for attempt in range(1, 8)]
        rate.report(chain[0], acknowledged=16 * (HT20.index(chain[0]) <= 3), frames=16)
        chains.append([HT20.index(mode) for mode in chain])
    samples = [number for number, chain in enumerate(chains) if chain[0] > 3]
    assert 50 <= len(samples) <= 100
    assert min(later - earlier for earlier, later in pairwise(samples)) >= 10
    assert all(max(chains[number][1:]) <= 3 for number in samples)
    assert {chains[number][0] for number in samples} == {4, 5, 6, 7}


def test_two_streams_that_suddenly_fail_are_replaced_within_the_interval() -> None:
    """If less than a quarter of more than 30 frames arrive, a group with fewer streams is used within 50 ms."""
    radio = groups("n", "5 GHz", 40, 2, 800)
    rate = make_control(*radio)
    modes_before = first_modes(rate, 1000, lambda _: 1.0)
    # More than 50 ms later, so that an update precedes the first of these frames.
    modes_after = first_modes(rate, 8, lambda mode: float(mode.streams == 1), start=1030)
    assert modes_before[-1].streams == 2
    assert modes_after[-1].streams == 1


def test_a_mode_that_works_again_is_used_again() -> None:
    rate = make_control(HT20)
    assert HT20.index(first_modes(rate, 1000, lambda mode: float(HT20.index(mode) <= 1))[-1]) <= 1
    modes = first_modes(rate, 1000, lambda _: 1.0, start=1000)
    assert Counter(modes[-200:]).most_common(1)[0][0] is HT20[7]


def test_the_first_frames_are_sent_in_the_slowest_mode() -> None:
    modes = first_modes(make_control(HT20), 500, lambda _: 1.0)
    assert modes[1] is HT20[0], "the first mode is a sample"
    # A sample every 20 ms and an update every 50 ms reach the fastest mode in a few updates.
    assert modes.index(HT20[7]) < 150


@given(st.lists(st.tuples(st.integers(0, 40_000_000), st.integers(0, 16)), max_size=200), st.integers(1, 3))
def test_any_results_leave_a_chain_of_known_modes(results: list[tuple[int, int]], streams: int) -> None:
    rate_groups = groups("ac", "5 GHz", 40, min(streams, 2), 400)
    rate = make_control(*rate_groups)
    modes = {mode for group in rate_groups for mode in group}
    now_ns = 0
    for number, (step_ns, acknowledged_frames) in enumerate(results):
        now_ns += step_ns
        chain = [rate.choose(now_ns, ("a", number), attempt) for attempt in range(1, 8)]
        assert set(chain) <= modes
        rate.report(chain[number % 7], acknowledged=acknowledged_frames, frames=16)
