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
from sim_backends.radio.modes import G_MODES, N_MODES, WifiMode, ack_ns, control_mode
from sim_backends.radio.packet_error import bit_error, decoded_bit_error, packet_error
from sim_backends.world.materials import SPEED_OF_LIGHT_M_S

MODES = pytest.mark.parametrize("mode", [*G_MODES, *N_MODES], ids=lambda mode: mode.name)
WIFI_HZ = 2.437e9
WAVELENGTH_M = SPEED_OF_LIGHT_M_S / WIFI_HZ


def test_rates_are_those_of_the_standard() -> None:
    assert [mode.rate_bit_s / 1e6 for mode in G_MODES] == [6, 9, 12, 18, 24, 36, 48, 54]
    assert [mode.rate_bit_s / 1e6 for mode in N_MODES] == [6.5, 13, 19.5, 26, 39, 52, 58.5, 65]


@MODES
def test_data_bits_per_symbol_follow_from_modulation_and_code(mode: WifiMode) -> None:
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
def test_uncoded_bit_error_is_proakis(mode: WifiMode) -> None:
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
def test_packet_error_falls_with_the_ratio_and_grows_with_the_size(mode: WifiMode) -> None:
    ratios = np.arange(-12, 42, 0.1)
    errors = [packet_error(mode, ratio, 1000) for ratio in ratios]
    assert errors[0] == 1
    assert errors[-1] < 1e-12
    assert all(more >= less for more, less in pairwise(errors))
    middle = next(ratio for ratio, error in zip(ratios, errors, strict=True) if error < 0.5)
    assert packet_error(mode, middle, 100) < packet_error(mode, middle, 1000) < packet_error(mode, middle, 1500)


@MODES
def test_packet_error_is_computed_over_bits_at_any_ratio(mode: WifiMode) -> None:
    """Read from a table, it is within 0.002 dB of the formula, at steps of the table and between them."""

    def by_formula(snr_db: float) -> float:
        return 1 - (1 - decoded_bit_error(mode, 10 ** (snr_db / 10))) ** 8000

    begin_db = next(ratio for ratio in np.arange(0, 40, 0.05) if packet_error(mode, ratio, 1000) < 0.9)
    for snr_db in np.arange(begin_db, begin_db + 1, 0.007):
        assert by_formula(snr_db + 0.002) <= packet_error(mode, snr_db, 1000) <= by_formula(snr_db - 0.002)


def test_faster_modes_need_more() -> None:
    def needed_db(mode: WifiMode) -> float:
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


Floats = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
WAYS_M = np.arange(0, 0.2001, 0.005)
SEEDS = 800
ANYWHERE = np.random.default_rng(1).uniform(0, 100, (SEEDS, 2, 1, 3))


def fading(seed: int, *links: tuple[str, str], stir_m_s: float = 0.0) -> Fading:
    ends = np.array([["abc".index(end) for end in link] for link in links or [("a", "b")]]).T
    return Fading(seed, "abc", ends, wavelength_m=WAVELENGTH_M, stir_m_s=stir_m_s)


def gains(of: Fading, start: Floats, end: Floats, *, now_ns: int = 0, k: float = 0.0, link: int = 0) -> Floats:
    echoes = of.echoes(np.full(len(start), link))
    return echoes.fades(start, end, None, np.full(len(start), k), now_ns).gains(0.0)


def gains_along(angle: float, *, first: float = 0.0, second: float = 1.0) -> Floats:
    """Return gains without sight per seed and way, as the ends go in a direction, each so much of the way."""
    ways = WAYS_M[:, None] * np.array((math.cos(angle), math.sin(angle), 0.0))
    return np.array(
        [gains(fading(seed), start + first * ways, end + second * ways) for seed, (start, end) in enumerate(ANYWHERE)]
    )


def demand_clarke(found: Floats, *ways: tuple[float, float]) -> None:
    """Ask for the autocovariance of a dozen echoes' power gain, of which that of many is the product of J0^2.

    Echoes turn with several ways, each a share of the way and an angle to it. One whose directions lie in sector n of
    a dozen correlates as r_n = E[exp(i turns cos(angle))] over its sectors, so the power of all does as
    (|sum r_n|^2 - sum |r_n|^2) / (12^2 - 12), which misses J0^2 by a twelfth at most.
    """
    centred = found - found.mean()
    for steps in (2, 4, 8, 20):
        turns = 2 * math.pi * WAYS_M[steps] / WAVELENGTH_M
        many = math.prod(special.j0(share * turns) ** 2 for share, _ in ways)
        echoes = np.ones(12, dtype=complex)
        for (share, angle), pairing in zip(ways, (5, 1, 7), strict=False):
            within = (np.arange(12)[:, None] * pairing % 12 + np.linspace(0, 1, 101)) * math.pi / 6
            echoes *= np.exp(1j * share * turns * np.cos(within - angle)).mean(axis=1)
        dozen = (abs(echoes.sum()) ** 2 - (abs(echoes) ** 2).sum()) / (12**2 - 12)
        assert dozen == pytest.approx(many, abs=1 / 12)
        measured = (centred[:, :-steps] * centred[:, steps:]).mean() / centred.var()
        assert measured == pytest.approx(dozen, abs=0.08)


def test_without_sight_the_gain_is_exponential() -> None:
    """Rayleigh: the power gain has the exponential distribution with mean 1."""
    found = gains_along(0.0)
    assert found.mean() == pytest.approx(1, abs=0.03)
    assert stats.kstest(found[:, 0], "expon").pvalue > 0.01


@pytest.mark.parametrize("k", [1.0, 4.0])
def test_with_sight_the_gain_is_rician(k: float) -> None:
    """Twice (K + 1) times the gain is noncentral chi-square with 2 degrees of freedom and noncentrality 2 K."""
    found = np.array([gains(fading(seed), *ends, k=k)[0] for seed, ends in enumerate(ANYWHERE)])
    assert found.mean() == pytest.approx(1, abs=0.06)
    assert stats.kstest(2 * (k + 1) * found, "ncx2", args=(2, 2 * k)).pvalue > 0.01


@pytest.mark.parametrize("angle", [0.0, -0.9])
def test_the_gain_changes_along_the_way_as_clarke_says(angle: float) -> None:
    demand_clarke(gains_along(angle), (1.0, angle))


def test_where_both_ends_go_the_gain_changes_as_akki_and_haber_say() -> None:
    """Two that go side by side fade as well: echoes come from around each, and correlations multiply."""
    demand_clarke(gains_along(0.4, first=0.5), (1.0, 0.4), (0.5, 0.4))


def test_what_stirs_around_two_that_stand_lets_them_fade_as_clarke_says() -> None:
    found = np.array(
        [
            [gains(fading(seed, stir_m_s=1.0), *ends, now_ns=round(way_m * 1e9))[0] for way_m in WAYS_M]
            for seed, ends in enumerate(ANYWHERE[:400])
        ]
    )
    demand_clarke(found, (0.0, 0.0), (0.0, 0.0), (1.0, 0.0))


def test_what_stands_still_does_not_fade() -> None:
    of, ends = fading(1), ANYWHERE[1]
    assert len({gains(of, *ends, now_ns=now_ns, k=1.0)[0] for now_ns in range(0, 10**9, 10**8)}) == 1


def test_a_link_fades_alike_whatever_other_links_there_are() -> None:
    one, many = fading(1, ("a", "b")), fading(1, ("a", "c"), ("a", "b"), ("b", "c"))
    assert gains(one, *ANYWHERE[0], k=1.0) == gains(many, *ANYWHERE[0], k=1.0, link=1)
