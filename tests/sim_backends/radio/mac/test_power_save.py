"""Power save as a distribution of delays: uniform up to a beacon interval or a DTIM, and none for awake stations."""

from collections.abc import Iterable

import pytest
import scipy
from typing_extensions import override

from fieldkit.config.profiles import Radio
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.core.links import RADIO_OFF, delay_parts
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.radio.mac.power_save import BEACON_INTERVAL_NS, DTIM_PERIOD
from sim_backends.radio.phy.modes import G_MODES
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import FixedPowers

TIMEOUT_NS = 100_000_000
FRAME_NS = 2_000_000


class DozingPowers(FixedPowers):
    """An access point `ap`, a station `pi` with power save, and a station `awake` without."""

    def __init__(self) -> None:
        super().__init__(("ap", "pi", "awake"), G_MODES[0])

    @override
    def power_save_timeout_ns(self, station: int) -> int | None:
        return TIMEOUT_NS if self.names[station] == "pi" else None


def make_wifi(seed: int = 1) -> Wifi[int]:
    model: Wifi[int] = Wifi(DozingPowers(), seed)
    model.set_relay("ap")
    return model


def delays_ns(source: str, destination: str | None, times_ns: Iterable[int], *, seed: int = 1) -> list[int]:
    """Return the delays of packets to `pi`, or to `destination`."""
    model, arrivals, send_times_ns = make_wifi(seed), {}, list(times_ns)
    for number, time_ns in enumerate(send_times_ns):
        for at_ns, receiver, payload, _, _ in model.deliveries(time_ns):
            arrivals[payload, receiver] = at_ns
        model.send(time_ns, source, number, 84, destination)
    for at_ns, receiver, payload, _, _ in model.deliveries(send_times_ns[-1] + 10**9):
        arrivals[payload, receiver] = at_ns
    receiver = destination or "pi"
    return [arrivals[number, receiver] - time_ns for number, time_ns in enumerate(send_times_ns)]


def isolated_times_ns(count: int) -> list[int]:
    """Return times about 1 s apart, at random phases of the beacon."""
    return [round(number * 1e9 + draw * 5e8) for number, draw in enumerate(RandomStream(7, "times").first(count))]


@pytest.mark.parametrize("source", ["ap", "awake"])
def test_isolated_packets_to_a_dozing_station_wait_uniformly_for_the_beacon(source: str) -> None:
    waits_ns = delays_ns(source, "pi", isolated_times_ns(400))
    assert min(waits_ns) > 0
    assert max(waits_ns) < BEACON_INTERVAL_NS + 2 * FRAME_NS
    assert scipy.stats.kstest([wait_ns / BEACON_INTERVAL_NS for wait_ns in waits_ns], "uniform").pvalue > 0.01


def test_broadcasts_wait_uniformly_for_the_dtim_and_reach_all_stations() -> None:
    interval_ns = DTIM_PERIOD * BEACON_INTERVAL_NS
    waits_ns = delays_ns("ap", None, isolated_times_ns(400))
    assert max(waits_ns) > BEACON_INTERVAL_NS
    assert scipy.stats.kstest([wait_ns / interval_ns for wait_ns in waits_ns], "uniform").pvalue > 0.01


def test_packets_from_a_dozing_station_and_between_others_do_not_wait() -> None:
    for source, destination in (("pi", "ap"), ("pi", "awake"), ("ap", "awake")):
        assert max(delays_ns(source, destination, isolated_times_ns(30))) < 2 * FRAME_NS


def test_a_station_stays_awake_for_its_timeout_after_its_last_frame() -> None:
    close_times_ns = [number * (TIMEOUT_NS - 1) for number in range(20)]
    assert max(delays_ns("ap", "pi", close_times_ns)[1:]) < FRAME_NS
    distant_times_ns = [number * (TIMEOUT_NS + BEACON_INTERVAL_NS + FRAME_NS) for number in range(20)]
    assert max(delays_ns("ap", "pi", distant_times_ns)[1:]) > 10 * FRAME_NS


def test_a_frame_of_the_station_releases_its_buffered_frames_in_order() -> None:
    model = make_wifi()
    beacon_ns = int(RandomStream(1, "beacon").draw(0) * DTIM_PERIOD * BEACON_INTERVAL_NS)
    start_ns = beacon_ns + 10 * BEACON_INTERVAL_NS + 1_000_000
    for number in range(3):
        model.send(start_ns, "ap", number, 84, "pi")
    assert model.deliveries(start_ns + 10_000_000) == []
    model.send(start_ns + 10_000_000, "pi", 99, 84, "ap")
    arrived_numbers = [
        payload for _, receiver, payload, _, _ in model.deliveries(start_ns + 20_000_000) if receiver == "pi"
    ]
    assert arrived_numbers == [0, 1, 2]


def test_the_time_in_the_buffer_counts_as_queueing() -> None:
    model = make_wifi()
    model.send(500_000_000, "ap", 0, 84, "pi")
    ((at_ns, _, _, _, delay),) = model.deliveries(10**9)
    parts = delay_parts(delay)
    assert parts.queuing_ns > 5_000_000
    assert parts.queuing_ns + parts.transmission_ns == at_ns - 500_000_000


def test_without_an_access_point_no_station_dozes() -> None:
    model: Wifi[int] = Wifi(DozingPowers(), 1)
    model.send(500_000_000, "ap", 0, 84, "pi")
    assert len(model.deliveries(500_000_000 + FRAME_NS)) == 1


def test_frames_buffered_by_an_access_point_that_is_switched_off_are_lost_once() -> None:
    model = make_wifi()
    losses: list[tuple[int, str, str]] = []
    model.log_losses(lambda _, payload, receiver, reason: losses.append((payload, receiver, reason)))
    for number in range(3):
        model.send(500_000_000, "ap", number, 84, "pi")
    model.switch_off(500_000_001, {"ap"})
    assert model.deliveries(10**9) == []
    assert losses == [(number, "pi", RADIO_OFF) for number in range(3)]


def test_the_keys_of_a_profile_are_those_of_the_model() -> None:
    fields = {"interface": "wlan0", "standard": "802.11n 2.4 GHz", "tx_power_dbm": 17, "sensitivity_dbm": -82}
    for phy, timeout_ns in (
        ({}, None),
        ({"power_save": True}, 100_000_000),
        ({"power_save": True, "power_save_timeout": "20ms"}, 20_000_000),
    ):
        capability = antenna_of(Radio.model_validate({**fields, "phy": phy})).phy
        assert capability is not None
        assert capability.power_save_timeout_ns == timeout_ns
