"""Modes, packet error, propagation, shadowing and fading, compared with tables of the standard and closed forms."""

import math
from itertools import pairwise

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.radio.phy.error_rates import bit_error, decoded_bit_error, packet_error
from sim_backends.radio.phy.modes import G_MODES, N_MODES, WifiMode, ack_ns, control_mode
from sim_backends.radio.propagation import path_loss
from sim_backends.radio.propagation.fading import Fading, Shadowing
from sim_backends.world.materials import SPEED_OF_LIGHT_M_S

MODES = pytest.mark.parametrize("mode", [*G_MODES, *N_MODES], ids=lambda mode: mode.name)
WIFI_HZ = 2.437e9
WAVELENGTH_M = SPEED_OF_LIGHT_M_S / WIFI_HZ


def test_rates_are_those_of_the_standard() -> None:
    assert [mode.rate_bit_s / 1e6 for mode in G_MODES] == [6, 9, 12, 18, 24, 36, 48, 54]
    assert [mode.rate_bit_s / 1e6 for mode in N_MODES] == [6.5, 13, 19.5, 26, 39, 52, 58.5, 65]


@MODES
def test_data_bits_per_symbol_follow_from_modulation_and_code(mode: WifiMode) -> None:
    subcarriers = 52 if mode.is_high_throughput else 48
    bits = {"BPSK": 1, "QPSK": 2, "16-QAM": 4, "64-QAM": 6}[mode.modulation]
    assert mode.bits_per_symbol == subcarriers * bits * mode.code_rate


def test_airtimes_equal_those_computed_by_hand() -> None:
    """1536 bytes at 54 Mbit/s: ceil((22 + 12288) / 216) = 57 symbols; an ACK of 14 bytes at 24: 2 symbols."""
    assert G_MODES[-1].airtime_ns(1536) == (20 + 57 * 4 + 6) * 1000
    assert N_MODES[-1].airtime_ns(1536) == (36 + 48 * 4 + 6) * 1000
    assert ack_ns(G_MODES[-1]) == (20 + 2 * 4 + 6) * 1000


def test_acks_use_the_fastest_mandatory_rate_up_to_that_of_the_frame() -> None:
    assert [control_mode(mode).name for mode in G_MODES] == ["g6", "g6", "g12", "g12", "g24", "g24", "g24", "g24"]
    assert [control_mode(mode).name for mode in N_MODES] == ["g6", "g12", "g12", "g24", "g24", "g24", "g24", "g24"]


@MODES
def test_the_uncoded_bit_error_rate_equals_that_of_proakis(mode: WifiMode) -> None:
    """The expected rates are those of Gray-coded M-QAM by Q functions, with errors to nearest neighbours only."""
    for snr_db in (5.0, 10.0, 15.0):
        snr = 10 ** (snr_db / 10)
        q = scipy.stats.norm.sf
        expected = {
            "BPSK": q(math.sqrt(2 * snr)),
            "QPSK": q(math.sqrt(snr)),
            "16-QAM": 3 / 4 * q(math.sqrt(snr / 5)),
            "64-QAM": 7 / 12 * q(math.sqrt(snr / 21)),
        }[mode.modulation]
        assert bit_error(mode, snr) == pytest.approx(expected, rel=1e-9)


@MODES
def test_packet_error_decreases_with_the_snr_and_increases_with_the_size(mode: WifiMode) -> None:
    ratios = np.arange(-12, 42, 0.1)
    errors = [packet_error(mode, ratio, 1000) for ratio in ratios]
    assert errors[0] == 1
    assert errors[-1] < 1e-12
    assert all(more >= less for more, less in pairwise(errors))
    middle_db = next(ratio for ratio, error in zip(ratios, errors, strict=True) if error < 0.5)
    assert (
        packet_error(mode, middle_db, 100) < packet_error(mode, middle_db, 1000) < packet_error(mode, middle_db, 1500)
    )


@MODES
def test_packet_error_from_the_table_equals_the_formula(mode: WifiMode) -> None:
    """The interpolated value is within 0.002 dB of the formula, at steps of the table and between them."""

    def by_formula(snr_db: float) -> float:
        return 1 - (1 - decoded_bit_error(mode, 10 ** (snr_db / 10))) ** 8000

    begin_db = next(ratio for ratio in np.arange(0, 40, 0.05) if packet_error(mode, ratio, 1000) < 0.9)
    for snr_db in np.arange(begin_db, begin_db + 1, 0.007):
        assert by_formula(snr_db + 0.002) <= packet_error(mode, snr_db, 1000) <= by_formula(snr_db - 0.002)


def test_faster_modes_need_a_higher_snr() -> None:
    def required_snr_db(mode: WifiMode) -> float:
        return next(ratio for ratio in np.arange(-5, 40, 0.05) if packet_error(mode, ratio, 1000) < 0.1)

    for modes in (G_MODES, N_MODES):
        required_snrs_db = [required_snr_db(mode) for mode in modes]
        assert required_snrs_db == sorted(required_snrs_db)
        assert 3 < required_snrs_db[0] < 5
        assert 21 < required_snrs_db[-1] < 25


PLACES = st.tuples(st.floats(1, 300), st.floats(0.1, 3), st.floats(0.1, 3))


@given(PLACES)
def test_two_ray_loss_is_near_the_direct_path_and_symmetric(heights_and_distance: tuple[float, ...]) -> None:
    distance_m, start_height_m, end_height_m = heights_and_distance
    start, end = np.array([[0, 0, start_height_m]]), np.array([[distance_m, 0, end_height_m]])
    direct_db = path_loss.free_space_db(start, end, WIFI_HZ)[0]
    two_ray_db = path_loss.two_ray_db(start, end, WIFI_HZ)[0]
    assert direct_db - 6.03 <= two_ray_db <= direct_db + 40.01
    assert two_ray_db == pytest.approx(path_loss.two_ray_db(end, start, WIFI_HZ)[0])


def test_far_two_ray_loss_is_40_db_per_decade() -> None:
    """Far means beyond 4 pi h1 h2 / wavelength (Rappaport, eq. 4.52)."""
    start = np.array([[0, 0, 0.5]] * 2)
    end = np.array([[100, 0, 0.5], [1000, 0, 0.5]])
    near_db, far_db = path_loss.two_ray_db(start, end, WIFI_HZ)
    assert far_db - near_db == pytest.approx(40, abs=1)
    plane_earth = 40 * math.log10(1000) - 20 * math.log10(0.25)
    assert far_db == pytest.approx(plane_earth, abs=1.5)


def test_free_space_and_log_distance_losses_equal_those_computed_by_hand() -> None:
    start, end = np.zeros((2, 3)), np.array([[1.0, 0, 0], [10, 0, 0]])
    assert path_loss.free_space_db(start, end, WIFI_HZ) == pytest.approx([40.18, 60.18], abs=0.01)
    assert path_loss.log_distance_db(start, end, WIFI_HZ, 3.0) == pytest.approx([40.18, 70.18], abs=0.01)
    inside = path_loss.free_space_db(start, end * 0.01, WIFI_HZ)
    assert inside == pytest.approx([40.18, 40.18], abs=0.01), "constant below 1 m"


def test_shadowing_has_the_given_variance_and_gudmundson_s_correlation() -> None:
    places = np.array([[step, 0.0, 0.0] for step in (0, 5, 10, 20, 40)])
    fields = [Shadowing(seed, 4.0, 10.0) for seed in range(1500)]
    # A path from a point to itself has twice the field of that point: sigma sqrt(2) F.
    values = np.array([field.loss_db(places, places) for field in fields]) / math.sqrt(2)
    covariance = np.cov(values.T)
    assert np.sqrt(np.diag(covariance)) == pytest.approx([4.0] * 5, rel=0.06)
    correlation = covariance[0] / covariance[0, 0]
    assert correlation == pytest.approx(np.exp(-places[:, 0] / 10), abs=0.07)
    forward, reverse = (
        fields[0].loss_db(start, end) for start, end in ((places, places[::-1]), (places[::-1], places))
    )
    np.testing.assert_allclose(forward, reverse)


Floats = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
PATHS_M = np.arange(0, 0.2001, 0.005)
SEEDS = 800
RANDOM_ENDS = np.random.default_rng(1).uniform(0, 100, (SEEDS, 2, 1, 3))


def fading(seed: int, *links: tuple[str, str], stir_m_s: float = 0.0) -> Fading:
    ends = np.array([["abc".index(end) for end in link] for link in links or [("a", "b")]]).T
    return Fading(seed, "abc", ends, wavelength_m=WAVELENGTH_M, stir_m_s=stir_m_s)


def gains(
    fading_model: Fading, start: Floats, end: Floats, *, now_ns: int = 0, k: float = 0.0, link: int = 0
) -> Floats:
    echoes = fading_model.echoes(np.full(len(start), link))
    return echoes.fades(start, end, None, np.full(len(start), k), now_ns).gains(0.0)


def gains_along(angle: float, *, first: float = 0.0, second: float = 1.0) -> Floats:
    """Return Rayleigh gains per seed and position, as the ends move in a direction, each by a share of the path."""
    paths = PATHS_M[:, None] * np.array((math.cos(angle), math.sin(angle), 0.0))
    return np.array(
        [
            gains(fading(seed), start + first * paths, end + second * paths)
            for seed, (start, end) in enumerate(RANDOM_ENDS)
        ]
    )


def assert_clarke_correlation(power_gains: Floats, *paths: tuple[float, float]) -> None:
    """Compare the autocovariance of the power gain of 12 echoes with theory; for many echoes it is a product of J0^2.

    The phases of echoes change with several movements, each given as a share of the path and an angle to it. An echo
    whose direction lies in sector n of 12 has the correlation r_n = E[exp(i turns cos(angle))] over its sectors, so
    the power of all has (|sum r_n|^2 - sum |r_n|^2) / (12^2 - 12), which differs from J0^2 by at most 1/12.
    """
    centred = power_gains - power_gains.mean()
    for steps in (2, 4, 8, 20):
        turns = 2 * math.pi * PATHS_M[steps] / WAVELENGTH_M
        of_many_echoes = math.prod(scipy.special.j0(share * turns) ** 2 for share, _ in paths)
        echoes = np.ones(12, dtype=complex)
        for (share, angle), pairing in zip(paths, (5, 1, 7), strict=False):
            angles = (np.arange(12)[:, None] * pairing % 12 + np.linspace(0, 1, 101)) * math.pi / 6
            echoes *= np.exp(1j * share * turns * np.cos(angles - angle)).mean(axis=1)
        expected = (abs(echoes.sum()) ** 2 - (abs(echoes) ** 2).sum()) / (12**2 - 12)
        assert expected == pytest.approx(of_many_echoes, abs=1 / 12)
        measured = (centred[:, :-steps] * centred[:, steps:]).mean() / centred.var()
        assert measured == pytest.approx(expected, abs=0.08)


def test_without_line_of_sight_the_gain_is_exponential() -> None:
    """Rayleigh: the power gain has the exponential distribution with mean 1."""
    power_gains = gains_along(0.0)
    assert power_gains.mean() == pytest.approx(1, abs=0.03)
    assert scipy.stats.kstest(power_gains[:, 0], "expon").pvalue > 0.01


@pytest.mark.parametrize("k", [1.0, 4.0])
def test_with_line_of_sight_the_gain_is_rician(k: float) -> None:
    """Twice (K + 1) times the gain is noncentral chi-square with 2 degrees of freedom and noncentrality 2 K."""
    power_gains = np.array([gains(fading(seed), *ends, k=k)[0] for seed, ends in enumerate(RANDOM_ENDS)])
    assert power_gains.mean() == pytest.approx(1, abs=0.06)
    assert scipy.stats.kstest(2 * (k + 1) * power_gains, "ncx2", args=(2, 2 * k)).pvalue > 0.01


@pytest.mark.parametrize("angle", [0.0, -0.9])
def test_the_gain_along_a_path_has_clarke_s_correlation(angle: float) -> None:
    assert_clarke_correlation(gains_along(angle), (1.0, angle))


def test_with_both_ends_moving_the_gain_has_akki_and_haber_s_correlation() -> None:
    """Two ends that move side by side also fade: echoes come from around each end, and correlations multiply."""
    assert_clarke_correlation(gains_along(0.4, first=0.5), (1.0, 0.4), (0.5, 0.4))


def test_moving_scatterers_cause_fading_with_clarke_s_correlation() -> None:
    power_gains = np.array(
        [
            [gains(fading(seed, stir_m_s=1.0), *ends, now_ns=round(path_m * 1e9))[0] for path_m in PATHS_M]
            for seed, ends in enumerate(RANDOM_ENDS[:400])
        ]
    )
    assert_clarke_correlation(power_gains, (0.0, 0.0), (0.0, 0.0), (1.0, 0.0))


def test_a_link_at_rest_does_not_fade() -> None:
    fading_model, ends = fading(1), RANDOM_ENDS[1]
    assert len({gains(fading_model, *ends, now_ns=now_ns, k=1.0)[0] for now_ns in range(0, 10**9, 10**8)}) == 1


def test_fading_of_a_link_does_not_depend_on_other_links() -> None:
    single_link, many_links = fading(1, ("a", "b")), fading(1, ("a", "c"), ("a", "b"), ("b", "c"))
    assert gains(single_link, *RANDOM_ENDS[0], k=1.0) == gains(many_links, *RANDOM_ENDS[0], k=1.0, link=1)
