"""Parsing of real outputs of iw versions 3 to 6 with eleven drivers, and of the kernel."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import StationSample
from fieldkit.measure.evidence import robot_link_samples
from tests.helpers.paths import DATA

STATIONS = {
    "station-rtl8723be-3": StationSample("d8:eb:97:ba:4d:b4", -42.0, 150e6, 1e6, 2781, 12679, 0, 0),
    "station-rtl8723bs-5": StationSample("<bssid>", -45.0, 72.2e6, None, 6618022, 1428888, None, 0),
    "station-mt76-4": StationSample("10:6f:3f:0e:31:8f", None, 54e6, 54e6, 187789, 161734, 4589, 0),
    "station-mt7603-6": StationSample("70:66:55:ce:21:3d", -29.0, 54e6, 54e6, 13502, 12427, 298, 4),
    "station-mwlwifi-4": StationSample("84:ba:3b:07:53:07", None, 1e6, 1e6, 418, 463, 0, 0),
    "station-ath12k-6": StationSample("00:03:7f:12:03:03", -95.0, 688.2e6, 619.5e6, 191, 320, 99, 0, 0),
    "station-iwlwifi-6": StationSample("04:f0:21:32:3f:d2", -60.0, 650e6, 650e6, 3441, 12577, 976, 0, 0),
    "station-hwsim-3": StationSample("02:00:00:00:00:00", -30.0, 1e6, None, 21, 3544, 0, 0),
    "station-hwsim-4": StationSample("02:00:00:00:00:00", -30.0, 1e6, 1e6, 21, 3812, 0, 0),
    "station-hwsim-5": StationSample("02:00:00:00:00:00", -30.0, 1e6, 1e6, 21, 3392, 0, 0, 1),
    "station-hwsim-6": StationSample("02:00:00:00:00:00", -30.0, 1e6, 1e6, 22, 4014, 0, 0, 1),
}


def output(name: str) -> str:
    return (DATA / "iw" / f"{name}.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", STATIONS)
def test_a_station_is_parsed_from_the_output_of_each_driver(name: str) -> None:
    assert robot_link_samples.parse_stations(output(name)) == (STATIONS[name],)


def test_several_stations_are_parsed() -> None:
    stations = robot_link_samples.parse_stations(output("station-iwlwifi-6") + output("station-mt7603-6"))
    assert stations == (STATIONS["station-iwlwifi-6"], STATIONS["station-mt7603-6"])
    assert [peer.signal_dbm for peer in robot_link_samples.parse_stations(output("stations-ap"))] == [-57.0]
    first_peer, peer = robot_link_samples.parse_stations(output("stations-hwsim-ap-6"))
    assert (first_peer.tx_packets, first_peer.tx_failures, peer.tx_packets, peer.tx_failures) == (13, 7, 6, 0)


def test_the_associated_access_point_is_parsed() -> None:
    assert robot_link_samples.parse_cell(output("link-rtl8812au")) == StationSample("xx:xx", -45.0, 216.7e6)
    raspberry_pi = robot_link_samples.parse_cell(output("link-station"))
    assert raspberry_pi == StationSample("f0:99:bf:0e:86:98", -65.0, 65e6, None, 1263, 25943), (
        "the driver brcmfmac of a Raspberry Pi"
    )
    assert (
        robot_link_samples.parse_cell(output("link-none"))
        is robot_link_samples.parse_cell(output("link-ibss"))
        is robot_link_samples.parse_cell(output("no-wifi"))
        is None
    )
    assert robot_link_samples.parse_cell(output("link-hwsim-ibss-6")) is None
    cell = StationSample("02:00:00:00:00:00", -30.0)
    assert robot_link_samples.parse_cell(output("link-hwsim-3")) == replace(
        cell, tx_rate_bit_s=1e6, tx_packets=21, rx_packets=3530
    )
    rates = replace(cell, tx_rate_bit_s=65e6, rx_rate_bit_s=1e6)
    assert robot_link_samples.parse_cell(output("link-hwsim-5")) == replace(rates, tx_packets=19, rx_packets=3320)
    rates = replace(cell, tx_rate_bit_s=1e6, rx_rate_bit_s=1e6)
    assert robot_link_samples.parse_cell(output("link-hwsim-6")) == replace(rates, tx_packets=21, rx_packets=3950)


def test_only_the_channel_in_use_is_parsed() -> None:
    assert robot_link_samples.parse_channel(output("survey-ath9k-4")) == (
        -95.0,
        1704490481 * 10**6,
        945335227 * 10**6,
    )
    assert robot_link_samples.parse_channel(output("survey-mt7996-6")) == (-84.0, 497753 * 10**6, 104676 * 10**6)
    assert robot_link_samples.parse_channel(output("survey-hwsim-6")) == (None, None, None), (
        "no channel is marked as in use"
    )
    assert (
        robot_link_samples.parse_channel(output("survey-ath10k-4"))
        == robot_link_samples.parse_channel("")
        == (None, None, None)
    )


def test_valid_powers_of_proc_net_wireless_are_parsed() -> None:
    def values_of_last_line(name: str) -> str:
        return output(name).splitlines()[-1].partition(":")[2].lstrip()

    assert robot_link_samples.parse_wireless(values_of_last_line("wireless-iwlwifi")) == (-42.0, None)
    assert robot_link_samples.parse_wireless(values_of_last_line("wireless-hwsim")) == (-30.0, None)
    assert robot_link_samples.parse_wireless(values_of_last_line("wireless-percent")) == (None, None)
    assert robot_link_samples.parse_wireless("0000   54.  -56.  -91.        0") == (-56.0, -91.0)


@given(st.sampled_from([*STATIONS, "link-station", "survey-mt7996-6"]), st.integers(0), st.binary(max_size=20))
def test_a_changed_output_raises_no_error(name: str, offset: int, replacement: bytes) -> None:
    complete = output(name).encode()
    offset %= len(complete)
    text = (complete[:offset] + replacement + complete[offset + len(replacement) :]).decode(errors="replace")
    for peer in robot_link_samples.parse_stations(text):
        assert peer.signal_dbm is None or -1000 < peer.signal_dbm < 0
    robot_link_samples.parse_cell(text)
    robot_link_samples.parse_channel(text)
    robot_link_samples.parse_wireless(text)
