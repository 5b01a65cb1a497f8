"""Time per packet of a station's bus and driver: a server with constant service time before the radio (D/D/1)."""

from dataclasses import replace

import pytest

from fieldkit.config.profiles import Radio
from sim_backends.radio.antennas import Antenna, antenna_of
from sim_backends.radio.core.links import QUEUE_FULL, delay_parts
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.phy.high_throughput import PhyCapability
from sim_backends.radio.radio_options import RadioOptions

MS = 10**6
PHY = PhyCapability("n", "2.4 GHz", 20, 1, 800)


def model(packet_time_ns: int, **options: object) -> WifiInWorld[int]:
    slow_antenna = Antenna("802.11n", 15.0, -88.0, replace(PHY, packet_time_ns=packet_time_ns))
    antennas = {"slow": slow_antenna, "fast": Antenna("802.11n", 15.0, -88.0, PHY)}
    radio: WifiInWorld[int] = WifiInWorld(
        1, RadioOptions.model_validate({"fading": False, **options}), antennas, None
    )
    radio.place(0, {"slow": (0.0, 0.0, 0.2), "fast": (5.0, 0.0, 0.2)}, None)
    return radio


def arrivals(radio: WifiInWorld[int], source: str, destination: str, count: int) -> list[tuple[int, int]]:
    """Return arrival time and processing delay of packets that are sent at one time."""
    for number in range(count):
        radio.send(0, source, number, 1000, destination)
    return [
        (at_ns, delay_parts(delay).processing_ns) for at_ns, _, _, _, delay in radio.deliveries(1000 * MS)
    ]  # fmt: skip


def test_packets_leave_a_slow_bus_one_after_the_other() -> None:
    packets = arrivals(model(2 * MS), "slow", "fast", 50)
    assert [processing_ns for _, processing_ns in packets] == [2 * MS * number for number in range(1, 51)]
    assert (packets[-1][0] - packets[0][0]) / 49 == pytest.approx(2 * MS, rel=0.02)


def test_packets_to_a_slow_station_are_not_delayed() -> None:
    assert arrivals(model(2 * MS), "fast", "slow", 50) == arrivals(model(0), "fast", "slow", 50)


def test_a_full_bus_queue_loses_packets() -> None:
    radio = model(2 * MS, queue_packets=10)
    reasons: list[str] = []
    radio.log_losses(lambda _, __, ___, reason: reasons.append(reason))
    assert (len(arrivals(radio, "slow", "fast", 50)), set(reasons)) == (11, {QUEUE_FULL})


def test_a_profile_sets_the_time() -> None:
    radio = {"interface": "wlan0", "standard": "802.11n 2.4 GHz", "tx_power_dbm": 15, "sensitivity_dbm": -88}
    phy = antenna_of(Radio.model_validate({**radio, "phy": {"packet_time": "2ms"}})).phy
    assert phy is not None
    assert phy.packet_time_ns == 2 * MS
