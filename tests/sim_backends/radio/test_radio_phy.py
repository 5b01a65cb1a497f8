"""Modes, packet error, propagation, shadowing and fading, against tables of the standard and closed forms."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

from sim_backends.radio import propagation
from sim_backends.radio.fading import Fading, Shadowing
from sim_backends.radio.modes import BASIC, G_MODES, N_MODES, Mode, ack_ns, control_mode
from sim_backends.radio.packet_error import bit_error, decoded_bit_error, packet_error
from sim_backends.radio.random_streams import DrawSequence
from sim_backends.radio.rate_control import Minstrel
from sim_backends.world.materials import SPEED_OF_LIGHT_M_S

MODES = pytest.mark.parametrize("mode", [*G_MODES, *N_MODES], ids=lambda mode: mode.name)
WIFI_HZ = 2.437e9
WAVELENGTH_M = SPEED_OF_LIGHT_M_S / WIFI_HZ


def test_rates_are_those_of_the_standard() -> None:
    assert [mode.rate_bit_s / 1e6 for mode in G_MODES] == [6, 9, 12, 18, 24, 36, 48, 54]
    assert [mode.rate_bit_s / 1e6 for mode in N_MODES] == [6.5, 13, 19.5, 26, 39, 52, 58.5, 65]


@MODES
def test_data_bits_per_symbol_follow_from_modulation_and_code(mode: Mode) -> None:
    subcarriers = 52 if mode.ht else 48
    bits = {"BPSK": 1, "QPSK": 2, "16-QAM": 4, "64-QAM": 6}[mode.modulation]
    assert mode.bits_per_symbol == subcarriers * bits * mode.code_rate


def test_airtimes_by_hand() -> None:
    """1536 bytes at 54 Mbit/s: ceil((22 + 12288) / 216) = 57 symbols; an ACK of 14 bytes at 24: 2 symbols."""
    assert G_MODES[-1].airtime_ns(1536) == (20 + 57 * 4 + 6) * 1000
    assert N_MODES[-1].airtime_ns(1536) == (36 + 48 * 4 + 6) * 1000
    assert ack_ns(G_MODES[-1]) == (20 + 2 * 4 + 6) * 1000


def test_acks_go_at_the_fastest_mandatory_rate_that_is_no_faster() -> None:
    assert [control_mode(mode).name for mode in G_MODES] == ["g6", "g6", "g12", "g12", "g24", "g24", "g24", "g24"]
    assert [control_mode(mode).name for mode in N_MODES] == ["g6", "g12", "g12", "g24", "g24", "g24", "g24", "g24"]


@MODES
def test_uncoded_bit_error_is_proakis(mode: Mode) -> None:
    """Gray-coded M-QAM by Q functions, the neighbours' terms only."""
    for snr_db in (5.0, 10.0, 15.0):
        snr = 10 ** (snr_db / 10)
        q = stats.norm.sf
        expected = {
            "BPSK": q(math.sqrt(2 * snr)),
            "QPSK": q(math.sqrt(snr)),
            "16-QAM": 3 / 4 * q(math.sqrt(snr / 5)),
            "64-QAM": 7 / 12 * q(math.sqrt(snr / 21)),
        }[mode.modulation]
        assert bit_error(mode, snr) == pytest.approx(expected, rel=1e-9)


@MODES
def test_packet_error_falls_with_the_ratio_and_grows_with_the_size(mode: Mode) -> None:
    ratios = np.arange(-12, 42, 0.1)
    errors = [packet_error(mode, ratio, 1000) for ratio in ratios]
    assert errors[0] == 1
    assert errors[-1] < 1e-12
    assert all(more >= less for more, less in pairwise(errors))
    middle = next(ratio for ratio, error in zip(ratios, errors, strict=True) if error < 0.5)
    assert packet_error(mode, middle, 100) < packet_error(mode, middle, 1000) < packet_error(mode, middle, 1500)


@MODES
def test_packet_error_is_computed_over_bits(mode: Mode) -> None:
    snr_db = next(ratio for ratio in np.arange(0, 40, 0.05) if packet_error(mode, ratio, 1000) < 0.1)
    snr_db = round(snr_db / 0.05) * 0.05 + 1e-6
    at_step = math.floor((snr_db + 10) / 0.05) * 0.05 - 10
    error = decoded_bit_error(mode, 10 ** (at_step / 10))
    assert packet_error(mode, snr_db, 1000) == pytest.approx(1 - (1 - error) ** 8000, rel=1e-6)


def test_faster_modes_need_more() -> None:
    def needed_db(mode: Mode) -> float:
        return next(ratio for ratio in np.arange(-5, 40, 0.05) if packet_error(mode, ratio, 1000) < 0.1)

    for modes in (G_MODES, N_MODES):
        needed = [needed_db(mode) for mode in modes]
        assert needed == sorted(needed)
        assert 3 < needed[0] < 5
        assert 21 < needed[-1] < 25


PLACES = st.tuples(st.floats(1, 300), st.floats(0.1, 3), st.floats(0.1, 3))


@given(PLACES)
def test_two_rays_oscillate_around_the_direct_one_and_fall_with_the_fourth_power(place: tuple[float, ...]) -> None:
    distance_m, here_m, there_m = place
    start, end = np.array([[0, 0, here_m]]), np.array([[distance_m, 0, there_m]])
    direct = propagation.free_space_db(start, end, WIFI_HZ)[0]
    both = propagation.two_ray_db(start, end, WIFI_HZ)[0]
    assert direct - 6.03 <= both <= direct + 40.01
    assert both == pytest.approx(propagation.two_ray_db(end, start, WIFI_HZ)[0])


def test_far_away_two_rays_lose_40_db_per_decade() -> None:
    """Beyond 4 pi h1 h2 / wavelength (Rappaport, eq. 4.52)."""
    start = np.array([[0, 0, 0.5]] * 2)
    end = np.array([[100, 0, 0.5], [1000, 0, 0.5]])
    near, far = propagation.two_ray_db(start, end, WIFI_HZ)
    assert far - near == pytest.approx(40, abs=1)
    plane_earth = 40 * math.log10(1000) - 20 * math.log10(0.25)
    assert far == pytest.approx(plane_earth, abs=1.5)


def test_friis_by_hand_and_the_exponent() -> None:
    start, end = np.zeros((2, 3)), np.array([[1.0, 0, 0], [10, 0, 0]])
    assert propagation.free_space_db(start, end, WIFI_HZ) == pytest.approx([40.18, 60.18], abs=0.01)
    assert propagation.log_distance_db(start, end, WIFI_HZ, 3.0) == pytest.approx([40.18, 70.18], abs=0.01)
    inside = propagation.free_space_db(start, end * 0.01, WIFI_HZ)
    assert inside == pytest.approx([40.18, 40.18], abs=0.01), "nearer than 1 m it stays"


def test_shadowing_has_its_variance_and_gudmundson_s_correlation() -> None:
    places = np.array([[step, 0.0, 0.0] for step in (0, 5, 10, 20, 40)])
    fields = [Shadowing(seed, 4.0, 10.0) for seed in range(1500)]
    # A path from a point to itself has twice the field of that point: sigma sqrt(2) F.
    values = np.array([one.loss_db(places, places) for one in fields]) / math.sqrt(2)
    covariance = np.cov(values.T)
    assert np.sqrt(np.diag(covariance)) == pytest.approx([4.0] * 5, rel=0.06)
    correlation = covariance[0] / covariance[0, 0]
    assert correlation == pytest.approx(np.exp(-places[:, 0] / 10), abs=0.07)
    there, back = (fields[0].loss_db(one, other) for one, other in ((places, places[::-1]), (places[::-1], places)))
    np.testing.assert_allclose(there, back)


def gains(k: float, *, speed_m_s: float = 1.0, seeds: int = 800) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    found, link = [], np.array([0])
    for seed in range(seeds):
        fading = Fading(seed, [("a", "b")], wavelength_m=WAVELENGTH_M)
        fading.use(0, link, speed_m_s=np.array([speed_m_s]), k=np.array([k]))
        found.append([fading.gains(at_ns, link)[0] for at_ns in range(0, 200_000_001, 5_000_000)])
    return np.array(found)


def test_without_sight_the_gain_is_exponential() -> None:
    """Rayleigh: the power gain has the exponential distribution with mean 1."""
    found = gains(0.0)
    assert found.mean() == pytest.approx(1, abs=0.03)
    assert stats.kstest(found[:, 0], "expon").pvalue > 0.01


@pytest.mark.parametrize("k", [1.0, 4.0])
def test_with_sight_the_gain_is_rician(k: float) -> None:
    """Twice (K + 1) times the gain is noncentral chi-square with 2 degrees of freedom and noncentrality 2 K."""
    found = gains(k)[:, 0]
    assert found.mean() == pytest.approx(1, abs=0.06)
    assert stats.kstest(2 * (k + 1) * found, "ncx2", args=(2, 2 * k)).pvalue > 0.01


def test_the_gain_changes_with_the_speed_as_clarke_says() -> None:
    """The autocovariance of a Rayleigh power gain is J0(2 pi f_d t)^2."""
    found = gains(0.0)
    centred = found - found.mean()
    for steps in (2, 4, 8, 20):
        measured = (centred[:, :-steps] * centred[:, steps:]).mean() / centred.var()
        lag_s = steps * 0.005
        assert measured == pytest.approx(special.j0(2 * math.pi * lag_s / WAVELENGTH_M) ** 2, abs=0.08)
    still = gains(0.0, speed_m_s=0.0, seeds=3)
    assert (still == still[:, :1]).all(), "what stands still does not fade"


def test_a_change_of_speed_makes_no_jump() -> None:
    both = np.arange(2)
    fading = Fading(1, ["a", "b"], wavelength_m=WAVELENGTH_M)
    fading.use(0, both, speed_m_s=np.array([2.0, 3.0]), k=np.ones(2))
    before = fading.gains(10**9, both)
    after = fading.gains(2 * 10**9, both)
    fading.use(10**9, both[:1], speed_m_s=np.array([0.1]), k=np.ones(1))
    np.testing.assert_allclose(fading.gains(10**9, both), before)
    assert fading.gains(2 * 10**9, both)[1] == pytest.approx(after[1]), "the other link goes on as it did"
    assert fading.gains(2 * 10**9, both)[0] != pytest.approx(after[0])


def test_a_link_fades_alike_whatever_other_links_there_are() -> None:
    pair, more = [("a", "b")], [("a", "c"), ("a", "b"), ("b", "c")]
    one, many = (Fading(1, links, wavelength_m=WAVELENGTH_M) for links in (pair, more))
    one.use(0, np.arange(1), speed_m_s=np.ones(1), k=np.ones(1))
    many.use(0, np.arange(3), speed_m_s=np.ones(3), k=np.ones(3))
    np.testing.assert_allclose(one.gains(10**8, np.array([0])), many.gains(10**8, np.array([1])))


@pytest.mark.parametrize(("snr_db", "expected"), [(35.0, "g54"), (15.0, "g24"), (5.0, "g6"), (-20.0, "g6")])
def test_minstrel_begins_with_what_the_ratio_promises(snr_db: float, expected: str) -> None:
    assert Minstrel(G_MODES, snr_db, DrawSequence(1, "a", "b")).choose(0).name == expected


def test_minstrel_follows_what_is_acknowledged_and_tries_others() -> None:
    rate = Minstrel(G_MODES, 35.0, DrawSequence(1, "a", "b"))
    used: list[str] = []
    for step in range(20_000):
        mode = rate.choose(step * 1_000_000)
        used.append(mode.name)
        rate.tell(mode, acknowledged=mode.bits_per_symbol <= 96)
    late = used[-5000:]
    assert late.count("g24") > 0.85 * len(late), "the fastest that gets through"
    assert late.count("g54") > 0, "it goes on trying"
    assert BASIC.name in late
