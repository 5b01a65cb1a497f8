"""Choice of the mode by what was acknowledged."""

from collections import Counter
from collections.abc import Callable

import pytest

from sim_backends.radio.minstrel import Minstrel
from sim_backends.radio.modes import G_MODES, WifiMode
from sim_backends.radio.random_streams import PacketDraws

STEP_NS = 1_000_000
PER_RENEWAL = 100


def minstrel(snr_db: float) -> Minstrel:
    return Minstrel(G_MODES, snr_db, PacketDraws(1, "a", "b"))


def sent(rate: Minstrel, frames: int, arrives: Callable[[WifiMode], bool], *, begin: int = 0) -> list[list[str]]:
    """Return the modes of the attempts at each of some frames, one per millisecond."""
    found = []
    for number in range(begin, begin + frames):
        attempts: list[str] = []
        acknowledged = False
        while not acknowledged and len(attempts) < 7:
            mode = rate.choose(number * STEP_NS, ("a", number), len(attempts) + 1)
            attempts.append(mode.name)
            acknowledged = arrives(mode)
            rate.tell(mode, acknowledged=acknowledged)
        found.append(attempts)
    return found


@pytest.mark.parametrize(("snr_db", "expected"), [(35.0, "g54"), (15.0, "g24"), (5.0, "g6"), (-20.0, "g6")])
def test_begins_with_what_the_ratio_promises(snr_db: float, expected: str) -> None:
    assert minstrel(snr_db).choose(0, ("a", 0), 1).name == expected


@pytest.mark.parametrize(
    ("snr_db", "expected"),
    [
        # All sure: twice the best, the second, the most robust (the fastest of the sure), then the slowest.
        (35.0, ["g54", "g54", "g48", "g48", "g54", "g54", "g6"]),
        # At 48 Mbit/s 37 % of 1200 bytes fail, so it comes after 36 Mbit/s. An exchange takes 0.30 ms there, and the
        # mean backoffs before the 2nd to 6th attempt are 67, 139, 283, 571 and 1147 us: six take 4.0 ms, seven 6.6.
        (20.81, ["g36", "g36", "g48", "g48", "g48", "g48", "g48"]),
        # Hopeless, so half as many as fit: of the slowest, at 1.7 ms, three do, and of the next four.
        (0.0, ["g6", "g9", "g9", "g6", "g6", "g6", "g6"]),
    ],
)
def test_falls_back(snr_db: float, expected: list[str]) -> None:
    frames = sent(minstrel(snr_db), PER_RENEWAL // 2, lambda _: False)
    assert Counter(map(tuple, frames)).most_common(1)[0][0] == tuple(expected)


def test_looking_at_slower_modes_costs_nothing_where_the_fastest_arrives() -> None:
    first = Counter(attempts[0] for attempts in sent(minstrel(35.0), 20_000, lambda _: True))
    assert first["g54"] > 0.98 * first.total()
    assert set(first) == {mode.name for mode in G_MODES}, "each once in a while, lest it be forgotten"


def test_looks_at_faster_modes_in_a_tenth_of_the_frames_and_each_four_times_per_renewal() -> None:
    frames = sent(minstrel(35.0), 20_000, lambda mode: mode.bits_per_symbol <= 96)[5_000:]
    looked = [attempts for attempts in frames if attempts[0] in {"g36", "g48", "g54"}]
    assert 0.06 < len(looked) / len(frames) < 0.1
    assert {tuple(attempts[2:]) for attempts in looked} == {("g24",)}, "twice, and then the best"
    for begin in range(0, len(frames), PER_RENEWAL):
        times = Counter(attempts[0] for attempts in frames[begin : begin + PER_RENEWAL])
        assert max(times[name] for name in ("g36", "g48", "g54")) <= 4
    assert Counter(attempts[0] for attempts in frames)["g24"] > 0.88 * len(frames)


def test_tries_without_limit_what_arrives_now_and_then() -> None:
    turns = iter(range(10**6))
    frames = sent(
        minstrel(35.0),
        20_000,
        lambda mode: mode.bits_per_symbol <= 144 or (mode.name == "g48" and next(turns) % 3 == 0),
    )[5_000:]
    per_renewal = [
        Counter(attempts[0] for attempts in frames[begin : begin + PER_RENEWAL])["g48"]
        for begin in range(0, len(frames), PER_RENEWAL)
    ]
    assert max(per_renewal) > 4


def test_goes_back_to_what_works_again() -> None:
    rate = minstrel(35.0)
    assert sent(rate, 2_000, lambda mode: mode.bits_per_symbol <= 48)[-1][0] == "g12"
    frames = sent(rate, 2_000, lambda _: True, begin=2_000)
    assert Counter(attempts[0] for attempts in frames[-200:])["g54"] > 190


def test_a_frame_more_shifts_no_other() -> None:
    numbers = range(60)
    one, other = minstrel(15.0), minstrel(15.0)
    chosen = [one.choose(0, ("a", number), 1) for number in numbers]
    assert [other.choose(0, ("a", number), 1) for number in numbers if number != 7] == chosen[:7] + chosen[8:]
    assert len(set(chosen)) > 1
