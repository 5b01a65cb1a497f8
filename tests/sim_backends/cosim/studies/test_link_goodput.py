"""Modes of logged links; predicted goodputs compared with closed forms."""

import math

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.executors import Workers
from sim_backends.cosim.studies.link_goodput import LoggedLink, predict_goodputs_bit_s

IN_PROCESS = Workers(1)


@pytest.mark.parametrize(
    ("link", "name"),
    [
        (LoggedLink(-50, mcs=7), "ht20-mcs7-1ss-800ns"),
        (LoggedLink(-50, mcs=15), "ht20-mcs15-2ss-800ns"),
        (LoggedLink(-50, "802.11ac 5 GHz", 80, 2, 400, mcs=9), "vht80-mcs9-2ss-400ns"),
        (LoggedLink(-50, "802.11ax 6 GHz", 40, 1, 1600, mcs=11), "he40-mcs11-1ss-1600ns"),
        (LoggedLink(-50, phy_rate_bit_s=50e6), "ht20-mcs5-1ss-800ns"),  # 52 Mbit/s
        (LoggedLink(-50, streams=2, phy_rate_bit_s=76e6), "ht20-mcs12-2ss-800ns"),  # 78 Mbit/s
        (LoggedLink(-50, "802.11g", phy_rate_bit_s=54e6), "g54"),
        (LoggedLink(-50, "802.11a", phy_rate_bit_s=11e6), "a12"),
    ],
)
def test_the_mode_is_that_of_the_mcs_or_has_the_nearest_rate(link: LoggedLink, name: str) -> None:
    mode = link.mode()
    assert mode is not None
    assert mode.name == name
    assert link.scenario({}).radio.mode == name


def test_without_mcs_and_rate_the_link_selects_its_modes() -> None:
    assert LoggedLink(-50).mode() is None


@pytest.mark.parametrize(
    "link",
    [
        LoggedLink(-50, "802.11ac 5 GHz", 80, 3, 400, mcs=9),
        LoggedLink(-50, "802.11ac 5 GHz", 20, 1, 800, mcs=9),
        LoggedLink(-50, "802.11ac 2.4 GHz", mcs=7),
        LoggedLink(-50, mcs=16),
        LoggedLink(-50, width_mhz=160, phy_rate_bit_s=100e6),
        LoggedLink(-50, streams=4),
        LoggedLink(-50, guard_interval_ns=3200, mcs=3),
        LoggedLink(-50, "802.11g", mcs=5),
        LoggedLink(-50, "802.11a", mcs=5, phy_rate_bit_s=48e6),
        LoggedLink(-50, width_mhz=160),
        LoggedLink(-50, "802.11a"),
    ],
)
def test_links_beyond_the_radio_model_have_a_reason_instead_of_a_goodput(link: LoggedLink) -> None:
    goodput = predict_goodputs_bit_s([link], {}, workers=IN_PROCESS)[link]
    assert isinstance(goodput, ConfigurationError)


def single_frame_goodput_bit_s(rate_mbit_s: int, payload_bytes: int) -> float:
    """Closed form of a saturated station with QoS and modes of 802.11a: AIFS, mean backoff, frame, SIFS, ACK."""
    symbols = math.ceil((16 + 6 + 8 * (payload_bytes + 28 + 8 + 26 + 4)) / (4 * rate_mbit_s))
    ack_symbols = math.ceil((16 + 6 + 8 * 14) / (4 * 24))
    cycle_us = (16 + 3 * 9) + 7.5 * 9 + (20 + 4 * symbols) + 16 + (20 + 4 * ack_symbols)
    return payload_bytes * 8e6 / cycle_us


def test_goodputs_equal_closed_forms_and_fall_with_the_signal() -> None:
    legacy = LoggedLink(-50, "802.11a", phy_rate_bit_s=54e6, protocol="udp")
    strong, weak, lost = (LoggedLink(signal_dbm, mcs=7, protocol="udp") for signal_dbm in (-50, -72, -80))
    goodputs = predict_goodputs_bit_s([legacy, strong, weak, lost], {}, workers=IN_PROCESS)
    assert goodputs[legacy] == pytest.approx(single_frame_goodput_bit_s(54, 1460), rel=0.01)
    values = [goodputs[link] for link in (strong, weak, lost)]
    assert all(isinstance(value, float) for value in values)
    assert 60e6 > values[0] > values[1] > values[2] == 0  # type: ignore[operator]


def test_a_fast_link_that_selects_its_modes_is_nearly_as_fast_as_its_best_mode() -> None:
    best, selecting = (LoggedLink(-40, "802.11ac 5 GHz", 40, 2, 400, mcs) for mcs in (9, None))
    goodputs = predict_goodputs_bit_s([best, selecting], {}, workers=IN_PROCESS)
    assert 0.6 * 400e6 < goodputs[best] < 0.85 * 400e6  # type: ignore[operator]
    assert goodputs[selecting] == pytest.approx(goodputs[best], rel=0.2)


@pytest.mark.parametrize(
    ("link", "packets"),
    [
        (LoggedLink(-50, mcs=7), 64),  # 65 Mbit/s
        (LoggedLink(-50, "802.11ac 5 GHz", 40, 2, 400, mcs=9), 261),  # 400 Mbit/s
        (LoggedLink(-50, "802.11ac 5 GHz", 40, 2, 400), 261),
    ],
)
def test_the_queue_contains_packets_of_1500_bytes_for_8_ms_but_at_least_64(link: LoggedLink, packets: int) -> None:
    assert link.scenario({}).radio.queue_packets == packets


def test_changes_of_the_scenario_apply() -> None:
    link = LoggedLink(-50, mcs=7, protocol="udp")
    noisy = predict_goodputs_bit_s([link], {"radio.noise_floor_dbm": -60}, workers=IN_PROCESS)
    assert noisy[link] == 0


PACKET_TIME = "agents.sender.radio.phy.packet_time"


@pytest.mark.parametrize(("changes", "packets"), [({}, 157), ({"radio.queue_packets": 70}, 70)])
def test_the_queue_of_a_slow_bus_contains_packets_for_8_ms(changes: dict[str, int], packets: int) -> None:
    """With a longer queue, TCP would recover from the losses of slow start during the measurement."""
    link = LoggedLink(-50, "802.11ac 5 GHz", 40, 2, 400, mcs=9)
    assert link.scenario({PACKET_TIME: "50us", **changes}).radio.queue_packets == packets


@pytest.mark.parametrize("protocol", ["tcp", "udp"])
def test_a_slow_bus_limits_the_goodput(protocol: str) -> None:
    link = LoggedLink(-50, "802.11ac 5 GHz", 40, 2, 400, mcs=9, protocol=protocol)
    goodput = predict_goodputs_bit_s([link], {PACKET_TIME: "500us"}, workers=IN_PROCESS)[link]
    assert goodput == pytest.approx(8 * 1460 / 500e-6, rel=0.02)


@pytest.mark.parametrize(("duration", "is_predicted"), [("0.5s", False), ("0.7s", True)])
def test_a_given_duration_is_that_of_the_measurement(duration: str, is_predicted: bool) -> None:
    link = LoggedLink(-50, mcs=7, protocol="udp")
    goodput = predict_goodputs_bit_s([link], {"duration": duration}, workers=IN_PROCESS)[link]
    assert isinstance(goodput, float) == is_predicted
