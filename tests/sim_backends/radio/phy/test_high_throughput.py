"""Modes of 802.11n, ac and ax, compared with the rate tables of the standard and with output of ns-3 3.37."""

from collections.abc import Sequence
from dataclasses import asdict

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.radio.antennas import Antenna, band_of, decode_antenna, fixed_mode, modes_between
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import HighThroughput, PhyCapability, format_modes, mode_names
from sim_backends.radio.phy.modes import ack_ns, control_mode


# Tables 19-27 ff. (HT), 21-29 ff. (VHT) and those of 27.5 (HE), Mbit/s.
@pytest.mark.parametrize(
    ("phy_format", "width_mhz", "streams", "guard_ns", "rates"),
    [
        ("HT", 20, 1, 400, (7.2, 14.4, 21.7, 28.9, 43.3, 57.8, 65, 72.2)),
        ("HT", 40, 1, 800, (13.5, 27, 40.5, 54, 81, 108, 121.5, 135)),
        ("HT", 40, 2, 400, (30, 60, 90, 120, 180, 240, 270, 300)),
        ("VHT", 20, 1, 800, (6.5, 13, 19.5, 26, 39, 52, 58.5, 65, 78)),
        ("VHT", 80, 1, 800, (29.3, 58.5, 87.8, 117, 175.5, 234, 263.3, 292.5, 351, 390)),
        ("VHT", 80, 2, 400, (65, 130, 195, 260, 390, 520, 585, 650, 780, 866.7)),
        ("HE", 20, 1, 800, (8.6, 17.2, 25.8, 34.4, 51.6, 68.8, 77.4, 86, 103.2, 114.7, 129, 143.4)),
        ("HE", 40, 1, 1600, (16.3, 32.5, 48.8, 65, 97.5, 130, 146.3, 162.5, 195, 216.7, 243.8, 270.8)),
        ("HE", 80, 2, 800, (72.1, 144.1, 216.2, 288.2, 432.4, 576.5, 648.5, 720.6, 864.7, 960.7, 1080.9, 1201)),
        ("HE", 80, 1, 3200, (30.6, 61.3, 91.9, 122.5, 183.8, 245, 275.6, 306.3, 367.5, 408.3, 459.4, 510.4)),
    ],
)
def test_rates_equal_those_of_the_tables(
    phy_format: HighThroughput, width_mhz: int, streams: int, guard_ns: int, rates: Sequence[float]
) -> None:
    modes = format_modes(phy_format, "5 GHz", width_mhz, streams, guard_ns)
    assert [mode.rate_bit_s / 1e6 for mode in modes] == pytest.approx(rates, abs=0.055)
    assert format_modes(phy_format, "5 GHz", width_mhz, streams, guard_ns) is modes


# Output of ns-3 (`benchmarks.high_throughput_vs_ns3`): WifiPhy::CalculateTxDuration at 5 GHz for 1538 bytes, in ns.
# The second number is the difference from ns-3: VHT-SIG-B (21.3.8.3.6), which ns-3 omits; HE-LTF of 7.2 us
# (27.3.11.10), for which ns-3 has 8 us; the end of the last symbol at a multiple of 4 us for short guard intervals
# (21.4.3).
@pytest.mark.parametrize(
    ("modes", "mcs", "ns3_ns", "difference_ns"),
    [
        (("VHT", 80, 2, 400), 9, 54_400, 4_000 + 1_600),
        (("HT", 40, 1, 800), 7, 128_000, 0),
        (("HE", 80, 1, 1600), 11, 72_800, 0),
        (("HE", 20, 2, 800), 0, 772_800, -1_600),
    ],
)
def test_airtimes_equal_those_of_ns3(
    modes: tuple[HighThroughput, int, int, int], mcs: int, ns3_ns: int, difference_ns: int
) -> None:
    phy_format, width_mhz, streams, guard_ns = modes
    mode = format_modes(phy_format, "5 GHz", width_mhz, streams, guard_ns)[mcs]
    assert mode.airtime_ns(1538) == ns3_ns + difference_ns


def test_a_frame_at_2_4_ghz_has_a_signal_extension_and_shorter_sifs() -> None:
    low, high = (format_modes("HE", band, 20, 1, 800)[7] for band in ("2.4 GHz", "5 GHz"))
    assert low.airtime_ns(1000) - high.airtime_ns(1000) == 6_000
    assert ack_ns(low) - ack_ns(high) == 6_000
    assert (low.band.difs_ns, high.band.difs_ns) == (28_000, 34_000)
    assert (control_mode(low).name, control_mode(high).name) == ("g24", "a24")


# Output of ns-3's NIST model for 1000 bytes (`errors` of `benchmarks/ns3_link.cc`).
@pytest.mark.parametrize(
    ("modes", "mcs", "snr_db", "error"),
    [
        (("VHT", 80, 2, 400), 8, 27.8, 0.391624),
        (("VHT", 80, 1, 800), 9, 29.0, 0.405279),
        (("HE", 80, 1, 800), 10, 33.6, 0.40755),
        (("HE", 80, 2, 3200), 11, 34.9, 0.37948),
        (("HT", 40, 1, 400), 7, 23.2, 0.330278),
    ],
)
def test_packet_errors_equal_those_of_ns3(
    modes: tuple[HighThroughput, int, int, int], mcs: int, snr_db: float, error: float
) -> None:
    phy_format, width_mhz, streams, guard_ns = modes
    mode = format_modes(phy_format, "5 GHz", width_mhz, streams, guard_ns)[mcs]
    assert packet_error(mode, snr_db, 1000) == pytest.approx(error, abs=1e-6)


AX80 = Antenna("802.11g", 17.0, -82.0, PhyCapability("ax", "5 GHz", 80, 2, 800))
AC40 = Antenna("802.11g", 17.0, -82.0, PhyCapability("ac", "5 GHz", 40, 1, 400))
N40 = Antenna("802.11g", 17.0, -82.0, PhyCapability("n", "2.4 GHz", 40, 2, 400))
G, N = Antenna("802.11g", 17.0, -82.0), Antenna("802.11n", 17.0, -82.0)


def test_two_stations_use_modes_that_both_support() -> None:
    assert {mode.name.split("-")[0] for mode in modes_between(AX80, AC40)} == {"vht40"}
    assert {mode.streams for mode in modes_between(AX80, AC40)} == {1}
    assert {mode.guard_interval_ns for mode in modes_between(AX80, AC40)} == {800}
    assert {mode.streams for mode in modes_between(AX80, AX80)} == {1, 2}
    assert [mode.name for mode in modes_between(N40, N)] == [f"n{mcs}" for mcs in range(8)]
    assert modes_between(N40, G)[-1].name == "g54"
    rates = [mode.rate_bit_s for mode in modes_between(AX80, AX80)]
    assert rates == sorted(rates)


def test_radios_of_different_bands_are_rejected() -> None:
    with pytest.raises(ConfigurationError, match=r"different bands cannot communicate: a at 5 GHz, b at 2\.4 GHz"):
        band_of({"a": AX80, "b": G})


def test_a_fixed_mode_must_exist_at_every_station() -> None:
    name = "vht40-mcs7-1ss-800ns"
    assert name in mode_names()
    mode = fixed_mode(name, {"a": AX80, "b": AC40})
    assert mode is not None
    assert mode.band.name == "5 GHz"
    with pytest.raises(ConfigurationError, match="is not a mode of the radio of b"):
        fixed_mode("vht80-mcs7-1ss-800ns", {"a": AX80, "b": AC40})


def test_an_encoded_antenna_is_decoded_without_change() -> None:
    for antenna in (AX80, G):
        assert decode_antenna(asdict(antenna)) == antenna
