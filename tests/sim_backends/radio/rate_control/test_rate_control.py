"""Rate control by acknowledgements."""

from collections import Counter
from collections.abc import Callable

import pytest

from sim_backends.radio.core.random_streams import PacketDraws
from sim_backends.radio.phy.high_throughput import format_modes
from sim_backends.radio.phy.modes import G_MODES, WifiMode
from sim_backends.radio.rate_control.minstrel import Minstrel

STEP_NS = 1_000_000
PER_UPDATE = 100


def minstrel(snr_db: float) -> Minstrel:
    return Minstrel(G_MODES, snr_db, PacketDraws(1, "a", "b"))


def attempted_modes(
    rate: Minstrel, frames: int, arrives: Callable[[WifiMode], bool], *, start: int = 0
) -> list[list[str]]:
    """Return the modes of all attempts for each of some frames, one frame per millisecond."""
    attempts_by_frame = []
    for number in range(start, start + frames):
        attempts: list[str] = []
        is_acknowledged = False
        while not is_acknowledged and len(attempts) < 7:
            mode = rate.choose(number * STEP_NS, ("a", number), len(attempts) + 1)
            attempts.append(mode.name)
            is_acknowledged = arrives(mode)
            rate.report(mode, acknowledged=is_acknowledged)
        attempts_by_frame.append(attempts)
    return attempts_by_frame


@pytest.mark.parametrize(("snr_db", "expected"), [(35.0, "g54"), (15.0, "g24"), (5.0, "g6"), (-20.0, "g6")])
def test_the_initial_mode_follows_from_the_snr(snr_db: float, expected: str) -> None:
    assert minstrel(snr_db).choose(0, ("a", 0), 1).name == expected


@pytest.mark.parametrize(
    ("snr_db", "expected"),
    [
        # All modes are reliable: two attempts each in the best, the second and the most robust mode, which is the
        # fastest reliable one; then one in the slowest.
        (35.0, ["g54", "g54", "g48", "g48", "g54", "g54", "g6"]),
        # At 48 Mbit/s, 37 % of frames of 1200 bytes fail, so this mode ranks below 36 Mbit/s. Its exchange takes
        # 0.30 ms, and the mean backoffs before the 2nd to 6th attempt are 67, 139, 283, 571 and 1147 us: six attempts
        # take 4.0 ms, and seven take 6.6 ms.
        (20.81, ["g36", "g36", "g48", "g48", "g48", "g48", "g48"]),
        # Almost all attempts fail, so each mode has half as many attempts as fit: one of three in the slowest mode,
        # at 1.7 ms each, and two of four in the next one.
        (0.0, ["g6", "g9", "g9", "g6", "g6", "g6", "g6"]),
    ],
)
def test_failed_attempts_fall_back_to_other_modes(snr_db: float, expected: list[str]) -> None:
    frames = attempted_modes(minstrel(snr_db), PER_UPDATE // 2, lambda _: False)
    assert Counter(map(tuple, frames)).most_common(1)[0][0] == tuple(expected)


def test_sampling_slower_modes_costs_nothing_if_the_fastest_succeeds() -> None:
    first_modes = Counter(attempts[0] for attempts in attempted_modes(minstrel(35.0), 20_000, lambda _: True))
    assert first_modes["g54"] > 0.98 * first_modes.total()
    assert set(first_modes) == {mode.name for mode in G_MODES}, "each mode is sampled occasionally"


def test_faster_modes_are_sampled_in_a_tenth_of_the_frames_and_each_at_most_four_times_per_update() -> None:
    frames = attempted_modes(minstrel(35.0), 20_000, lambda mode: mode.bits_per_symbol <= 96)[5_000:]
    samples = [attempts for attempts in frames if attempts[0] in {"g36", "g48", "g54"}]
    assert 0.06 < len(samples) / len(frames) < 0.1
    assert {tuple(attempts[2:]) for attempts in samples} == {("g24",)}, (
        "two attempts in the sampled mode, and then the best mode"
    )
    for start in range(0, len(frames), PER_UPDATE):
        counts = Counter(attempts[0] for attempts in frames[start : start + PER_UPDATE])
        assert max(counts[name] for name in ("g36", "g48", "g54")) <= 4
    assert Counter(attempts[0] for attempts in frames)["g24"] > 0.88 * len(frames)


def test_modes_with_occasional_success_are_sampled_without_limit() -> None:
    attempts_of_g48 = iter(range(10**6))
    frames = attempted_modes(
        minstrel(35.0),
        20_000,
        lambda mode: mode.bits_per_symbol <= 144 or (mode.name == "g48" and next(attempts_of_g48) % 3 == 0),
    )[5_000:]
    samples_per_update = [
        Counter(attempts[0] for attempts in frames[start : start + PER_UPDATE])["g48"]
        for start in range(0, len(frames), PER_UPDATE)
    ]
    assert max(samples_per_update) > 4


def test_a_mode_that_works_again_is_used_again() -> None:
    rate = minstrel(35.0)
    assert attempted_modes(rate, 2_000, lambda mode: mode.bits_per_symbol <= 48)[-1][0] == "g12"
    frames = attempted_modes(rate, 2_000, lambda _: True, start=2_000)
    assert Counter(attempts[0] for attempts in frames[-200:])["g54"] > 190


def test_an_additional_frame_does_not_change_the_modes_of_other_frames() -> None:
    numbers = range(60)
    with_frame, without_frame = minstrel(15.0), minstrel(15.0)
    chosen_modes = [with_frame.choose(0, ("a", number), 1) for number in numbers]
    assert [without_frame.choose(0, ("a", number), 1) for number in numbers if number != 7] == chosen_modes[
        :7
    ] + chosen_modes[8:]
    assert len(set(chosen_modes)) > 1


def test_aggregates_that_fail_lower_the_rate_within_the_interval() -> None:
    """From the start, all frames of the fastest modes fail, as in a fade; the interval of updates is 100 ms."""
    modes = format_modes("HE", "5 GHz", 80, 1, 800)
    control = Minstrel(modes, 60.0, PacketDraws(1, "a", "b"), frames_per_exchange=16)
    chosen_modes = []
    for number in range(60):
        mode = control.choose(number * 500_000, ("flow", number), 1)
        control.report(mode, acknowledged=64 * (mode.rate_bit_s < 200e6), frames=64)
        chosen_modes.append(mode.rate_bit_s)
    assert chosen_modes[0] > 500e6
    assert sorted(chosen_modes[-20:])[10] < 200e6, "the median of the last frames, some of which are samples"


def test_the_first_modes_consider_the_noise_of_the_width() -> None:
    """At 20 dB in 20 MHz the ratio in 80 MHz is 14 dB."""
    narrow, wide = (
        Minstrel(format_modes("HE", "5 GHz", width_mhz, 1, 800), 20.0, PacketDraws(1, "a", "b"))
        for width_mhz in (20, 80)
    )
    first_modes = [control.choose(0, ("flow", 5), 2).name for control in (narrow, wide)]
    assert first_modes == ["he20-mcs4-1ss-800ns", "he80-mcs3-1ss-800ns"]
