"""Rate control of firmware compared with closed forms, and the keys of both kinds of rate control in the model."""

from dataclasses import asdict

import numpy as np
import pytest

from fieldkit.config.profiles import Radio
from fieldkit.config.wifi_phy import WifiRateControl
from sim_backends.radio.antennas import Antenna, antenna_of, decode_antenna
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import PhyCapability, common_modes, format_modes
from sim_backends.radio.phy.modes import CW_MIN, SLOT_NS, WifiMode, response_ns
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.rate_control.firmware_rate import FirmwareRate, required_db, useful_modes
from sim_backends.radio.wifi import Wifi
from sim_backends.radio.world_channel import WorldChannel

HT20 = format_modes("HT", "2.4 GHz", 20, 1, 800)
VHT80 = PhyCapability("ac", "5 GHz", 80, 2, 400)


def firmware(snr_db: float, *, margin_db: float = 0.0, modes: tuple[WifiMode, ...] = HT20) -> FirmwareRate:
    return FirmwareRate(modes, lambda _: snr_db, margin_db=margin_db, interval_ns=100_000_000)


@pytest.mark.parametrize("margin_db", [0.0, 3.0])
def test_the_fastest_mode_with_at_most_a_tenth_of_errors_is_selected(margin_db: float) -> None:
    for snr_db in range(3, 40):
        usable = [mode for mode in HT20 if packet_error(mode, snr_db - margin_db, 1200) <= 0.1] or [HT20[0]]
        assert firmware(snr_db, margin_db=margin_db).choose(0, ("a", 0), 1) is usable[-1]


def test_each_further_attempt_is_one_step_slower() -> None:
    rate = firmware(35.0)
    assert [HT20.index(rate.choose(0, ("a", 0), attempt)) for attempt in range(1, 8)] == [7, 6, 5, 4, 3, 2, 1]


def test_losses_lower_the_mode_one_step_per_interval_and_success_raises_it_again() -> None:
    """The signal suffices for MCS 7, but only MCS 4 and slower modes arrive, as with interference at the receiver."""
    rate, chosen_indices = firmware(35.0), []
    for number in range(1200):
        is_received = (lambda index: index <= 4) if number < 600 else (lambda _: True)
        index = HT20.index(rate.choose(number * 1_000_000, ("a", number), 1))
        rate.report(HT20[index], acknowledged=int(is_received(index)))
        chosen_indices.append(index)
    assert chosen_indices[50:600:100] == [7, 6, 5, 4, 5, 4]
    assert chosen_indices[-1] == 7


def test_rates_and_required_signals_increase_from_step_to_step() -> None:
    steps = useful_modes(common_modes(VHT80, VHT80))
    assert [mode.rate_bit_s for mode in steps] == sorted({mode.rate_bit_s for mode in steps})
    assert [required_db(mode) for mode in steps] == sorted(required_db(mode) for mode in steps)
    for mode in common_modes(VHT80, VHT80):
        assert any(step.rate_bit_s >= mode.rate_bit_s and required_db(step) <= required_db(mode) for step in steps)


def test_a_wide_channel_has_more_noise() -> None:
    narrow, wide = (format_modes("VHT", "5 GHz", width_mhz, 1, 800)[3] for width_mhz in (20, 80))
    assert required_db(wide) - required_db(narrow) == pytest.approx(decibel(4), abs=0.02)


def run_radio(rate_control: WifiRateControl, ratio_db: float) -> tuple[float, list[TransmissionAttempt]]:
    """Return goodput in bit/s, and the attempts, of a saturated station with 802.11n at a fixed signal, for 2 s."""
    phy = PhyCapability("n", "2.4 GHz", 20, 1, 800, rate_control)
    antennas = dict.fromkeys("ab", Antenna("802.11n", 17.0, -92.0, phy))
    channel = WorldChannel(1, antennas, RadioOptions(fading=False, noise_floor_dbm=-95.0))
    channel.use_losses(np.where(np.eye(2, dtype=bool), np.inf, 17.0 + 95.0 - ratio_db))
    wifi: Wifi[int] = Wifi(channel, 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    lost_numbers: list[int] = []
    wifi.log_losses(lambda _, payload, *rest: lost_numbers.append(payload))
    for number in range(150):
        wifi.send(0, "a", number, 1028, "b")
    arrival_count = 0
    while (now_ns := wifi.next_event_ns()) is not None and now_ns < 2_000_000_000:
        arrived_numbers = [payload for _, _, payload, _, _ in wifi.deliveries(now_ns)]
        arrival_count += len(arrived_numbers)
        for number in arrived_numbers + lost_numbers:
            wifi.send(now_ns, "a", number, 1028, "b")
        lost_numbers.clear()
    return arrival_count * 8000 / 2.0, [attempt for attempt in log if attempt.number]


def closed_form_bit_s(mode: WifiMode, ratio_db: float) -> float:
    """Full A-MPDUs of 61 frames or 5.484 ms, mean backoff, Block Ack; each lost frame is sent once more."""
    frames = min(61, int((5_484_000 - mode.preamble_ns) * mode.rate_bit_s / 1e9 / 8 / 1072))
    exchange_ns = (
        mode.band.best_effort_aifs_ns
        + CW_MIN / 2 * SLOT_NS
        + mode.airtime_ns(1072 * frames)
        + mode.band.sifs_ns
        + response_ns(mode, 32)
    )
    return frames * 8000 / exchange_ns * 1e9 * (1 - packet_error(mode, ratio_db, 1066))


@pytest.mark.parametrize(
    ("rate_control", "ratio_db", "index", "min_ratio"),
    [
        ("firmware", 40.0, 7, 0.98),
        ("firmware", 20.0, 4, 0.98),
        ("firmware", 12.0, 1, 0.98),
        ("minstrel_ht", 40.0, 7, 0.93),
        ("minstrel_ht", 20.0, 4, 0.90),
        ("minstrel_ht", 12.0, 2, 0.90),
    ],
)
def test_goodput_at_a_fixed_signal_follows_the_closed_form(
    rate_control: WifiRateControl, ratio_db: float, index: int, min_ratio: float
) -> None:
    """minstrel_ht starts at the slowest mode, and samples modes that fail or are slower, up to 50 times a second."""
    goodput, _ = run_radio(rate_control, ratio_db)
    assert min_ratio <= goodput / closed_form_bit_s(HT20[index], ratio_db) <= 1.02


def test_the_keys_of_a_profile_are_those_of_the_model() -> None:
    fields = {"interface": "wlan0", "standard": "802.11n 2.4 GHz", "tx_power_dbm": 17, "sensitivity_dbm": -82}
    phy = {
        "rate_control": "firmware",
        "firmware_margin_db": 6,
        "firmware_interval": "50ms",
        "rts_threshold_bytes": 500,
    }
    antenna = antenna_of(Radio.model_validate({**fields, "phy": phy}))
    assert antenna.phy is not None
    assert (antenna.phy.rate_control, antenna.phy.firmware_margin_db, antenna.phy.firmware_interval_ns) == (
        "firmware",
        6.0,
        50_000_000,
    )
    assert antenna.phy.rts_threshold_bytes == 500
    assert decode_antenna(asdict(antenna)) == antenna
