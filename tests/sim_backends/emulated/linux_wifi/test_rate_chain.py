"""Rate chains of mac80211 in the modes of the radio model."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.linux_wifi.hwsim_messages import (
    RATE_40_MHZ,
    RATE_MCS,
    RATE_SHORT_GUARD_INTERVAL,
    RATE_VHT,
    RateStage,
)
from sim_backends.emulated.linux_wifi.rate_chain import legacy_index, mode_of, rate_chain
from sim_backends.radio.phy.modes import SHORT_RETRY_LIMIT


@pytest.mark.parametrize(
    ("stage", "frequency_mhz", "name"),
    [
        (RateStage(0, 1), 2437, "g6"),  # 1 Mbit/s, DSSS
        (RateStage(3, 1), 2437, "g6"),  # 11 Mbit/s, CCK
        (RateStage(4, 1), 2437, "g6"),
        (RateStage(11, 1), 2437, "g54"),
        (RateStage(12, 1), 2437, None),
        (RateStage(0, 1), 5180, "g6"),
        (RateStage(7, 1), 5180, "g54"),
        (RateStage(8, 1), 5180, None),
        (RateStage(7, 1, RATE_MCS), 2437, "n7"),
        (RateStage(7, 1, RATE_MCS | RATE_SHORT_GUARD_INTERVAL), 2437, "n7"),
        (RateStage(8, 1, RATE_MCS), 2437, None),  # two streams
        (RateStage(0, 1, RATE_MCS | RATE_40_MHZ), 2437, None),
        (RateStage(0x13, 1, RATE_VHT), 5180, None),  # two streams
        (RateStage(9, 1, RATE_VHT), 5180, None),  # 256-QAM
    ],
)
def test_a_stage_has_the_mode_of_its_rate_and_band(stage: RateStage, frequency_mhz: int, name: str | None) -> None:
    mode = mode_of(stage, frequency_mhz)
    assert (mode.name if mode else None) == name


def test_the_index_of_a_received_rate_has_the_modulation_of_its_mcs() -> None:
    mcs_3, g54 = mode_of(RateStage(3, 1, RATE_MCS), 2437), mode_of(RateStage(7, 1), 5180)
    assert mcs_3 is not None
    assert g54 is not None
    assert legacy_index(mcs_3, 2437) == 8  # 24 Mbit/s: 16-QAM 1/2, after four rates of 802.11b
    assert (legacy_index(g54, 2437), legacy_index(g54, 5180)) == (11, 7)


def test_tries_are_reported_in_their_stages() -> None:
    chain = rate_chain((RateStage(7, 2, RATE_MCS), RateStage(3, 1, RATE_MCS), RateStage(4, 9)), 2437)
    assert [mode.name for mode in chain.modes] == ["n7", "n7", "n3", "g6", "g6", "g6", "g6"]
    assert [chain.tries_made(attempts) for attempts in (1, 2, 3, 4, 7)] == [[1], [2], [2, 1], [2, 1, 1], [2, 1, 4]]


def test_a_stage_that_the_model_does_not_have_counts_as_failed() -> None:
    chain = rate_chain((RateStage(15, 2, RATE_MCS), RateStage(7, 2, RATE_MCS)), 2437)
    assert [mode.name for mode in chain.modes] == ["n7", "n7"]
    assert chain.tries_made(1) == [2, 1]
    unknown_chain = rate_chain((RateStage(15, 3, RATE_MCS),), 2437)
    assert (unknown_chain.modes, unknown_chain.tries_made(0)) == ((), [3])


stages = st.builds(
    RateStage, st.integers(-1, 127), st.integers(0, 255), st.sampled_from([0, RATE_MCS, RATE_VHT, RATE_40_MHZ])
)


@given(st.lists(stages, max_size=4), st.sampled_from([2412, 2484, 5180, 5955]), st.integers(1, SHORT_RETRY_LIMIT))
def test_any_chain_has_few_tries_and_its_report_adds_up(
    chain_stages: list[RateStage], frequency_mhz: int, max_tries: int
) -> None:
    chain = rate_chain(chain_stages, frequency_mhz, max_tries=max_tries)
    assert len(chain.modes) <= max_tries
    for attempts in range(1, len(chain.modes) + 1):
        tries = chain.tries_made(attempts)
        tries_on_air = sum(count for count, skipped in zip(tries, chain.is_skipped, strict=False) if not skipped)
        assert tries_on_air == attempts
        assert all(0 <= count <= 255 for count in tries)
