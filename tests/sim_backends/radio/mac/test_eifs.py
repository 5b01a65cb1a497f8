"""EIFS (IEEE 802.11-2020, 10.3.2.3.7), compared with its closed form and with ns-3."""

import math
from collections.abc import Sequence

import pytest
from typing_extensions import override

from sim_backends.radio.core.links import Delivery
from sim_backends.radio.mac.frames import HEADER_BYTES, TransmissionAttempt
from sim_backends.radio.mac.overhearing import certain_ratios, decoding_probability
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import format_modes
from sim_backends.radio.phy.modes import (
    BANDS,
    CW_MIN,
    DIFS_NS,
    G_MODES,
    OFDM_MODES,
    SIFS_NS,
    SLOT_NS,
    WifiMode,
    ack_ns,
)
from sim_backends.radio.phy.transmissions import Transmission
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import HEADERS_BYTES, NOISE_MW, FixedPowers

G54, G6 = G_MODES[-1], G_MODES[0]
EIFS_NS = SIFS_NS + ack_ns(G6) + DIFS_NS
"""10.3.7, with the ACK at 6 Mbit/s."""

STRONG_DB, ONLY_ACK_DB, ONLY_PREAMBLE_DB = 50.0, 15.0, 5.0
"""At 15 dB, 24 Mbit/s is decoded and 54 Mbit/s is not; at 5 dB, neither is."""


class Powers(FixedPowers):
    """A channel with the ratio of signal to noise of each pair; other pairs do not receive each other."""

    def __init__(self, names: Sequence[str], ratios_db: dict[str, float], mode: WifiMode = G54) -> None:
        super().__init__(names, mode)
        self.sensitivity_mw = [NOISE_MW] * len(names)
        for transmitter, row in zip(names, self.rows, strict=True):
            row[:] = [NOISE_MW * 10 ** (ratios_db.get(transmitter + name, -100) / 10) for name in names]


def start_after(ratios_db: dict[str, float], seed: int) -> tuple[int, int, int]:
    """Return the ends of a frame from a to b and of its ACK, and the start of c, which waits for the channel."""
    wifi: Wifi[str] = Wifi(Powers("abc", {"ab": STRONG_DB, "ba": STRONG_DB, "cb": STRONG_DB, **ratios_db}), seed)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    wifi.send(0, "a", "data", 1500, "b")
    wifi.send(100_000, "c", "waiting", 100, "b")
    wifi.deliveries(10**7)
    data, ack = log[:2]
    return data.end_ns, ack.end_ns, next(attempt.start_ns for attempt in log if attempt.transmitter == "c")


@pytest.mark.parametrize(
    ("ratios_db", "counts_after_ack", "wait_ns"),
    [
        ({"ac": STRONG_DB, "bc": STRONG_DB}, True, DIFS_NS),
        ({"ac": STRONG_DB}, True, DIFS_NS),
        ({"ac": ONLY_ACK_DB, "bc": STRONG_DB}, True, DIFS_NS),
        ({"ac": ONLY_ACK_DB, "bc": ONLY_ACK_DB}, True, DIFS_NS),
        ({"ac": ONLY_ACK_DB}, False, EIFS_NS),
        ({"ac": ONLY_PREAMBLE_DB, "bc": ONLY_PREAMBLE_DB}, True, EIFS_NS),
        ({"ac": STRONG_DB, "bc": ONLY_PREAMBLE_DB}, True, EIFS_NS),
    ],
    ids=[
        "decodes both",
        "has the reservation of the data",
        "the ACK ends EIFS",
        "a weak ACK ends EIFS",
        "does not detect the ACK",
        "decodes none of both",
        "does not decode the ACK",
    ],
)
def test_a_station_waits_for_eifs_after_a_frame_that_it_did_not_decode(
    ratios_db: dict[str, float], counts_after_ack: bool, wait_ns: int
) -> None:
    slots = set()
    for seed in range(25):
        data_end_ns, ack_end_ns, start_ns = start_after(ratios_db, seed)
        slot, rest_ns = divmod(start_ns - (ack_end_ns if counts_after_ack else data_end_ns) - wait_ns, SLOT_NS)
        assert rest_ns == 0
        slots.add(slot)
    assert slots <= set(range(CW_MIN + 1))
    assert len(slots) > 10, "only the backoff is random"


class ProtectedPowers(Powers):
    """Stations that send RTS."""

    @override
    def rts_threshold_bytes(self, station: int) -> int:
        return 0 if station == 0 else 10_000


@pytest.mark.parametrize("ratio_db", [STRONG_DB, ONLY_PREAMBLE_DB])
def test_only_a_cts_that_is_decoded_reserves_the_channel(ratio_db: float) -> None:
    """Station c detects only b, to which a sends data after RTS and CTS."""
    ratios_db = {"ab": STRONG_DB, "ba": STRONG_DB, "cb": STRONG_DB, "bc": ratio_db}
    wifi: Wifi[str] = Wifi(ProtectedPowers("abc", ratios_db), 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    wifi.send(0, "a", "data", 1500, "b")
    wifi.send(50_000, "c", "waiting", 100, "b")
    wifi.deliveries(10**7)
    cts = next(attempt for attempt in log if attempt.control == "CTS")
    start_ns = next(attempt.start_ns for attempt in log if attempt.transmitter == "c")
    reserved_ns = 2 * SIFS_NS + G54.airtime_ns(1500 + HEADER_BYTES) + ack_ns(G54)
    waits_from_ns = cts.end_ns + (reserved_ns + DIFS_NS if ratio_db == STRONG_DB else EIFS_NS)
    slots, rest_ns = divmod(start_ns - waits_from_ns, SLOT_NS)
    assert rest_ns == 0
    assert 0 <= slots <= CW_MIN


def test_a_sender_waits_for_eifs_after_an_ack_that_it_did_not_decode() -> None:
    wifi: Wifi[str] = Wifi(Powers("ab", {"ab": STRONG_DB, "ba": ONLY_PREAMBLE_DB}), 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    wifi.send(0, "a", "data", 1500, "b")
    wifi.deliveries(10**9)
    data, acks = ([attempt for attempt in log if bool(attempt.number) == is_data] for is_data in (True, False))
    waits_ns = [later.start_ns - ack.end_ns - EIFS_NS for later, ack in zip(data[1:], acks, strict=False)]
    assert len(waits_ns) == 6
    assert all(wait_ns >= 0 and wait_ns % SLOT_NS == 0 for wait_ns in waits_ns)


def test_a_station_that_decodes_one_frame_of_an_aggregate_does_not_wait_for_eifs() -> None:
    """The reception of 64 frames with an error rate of 90 % fails with a probability of 0.1 %."""
    mode = format_modes("HT", "2.4 GHz", 20, 1, 800)[7]
    ratio_db = next(step / 100 for step in range(4000) if packet_error(mode, step / 100, 1000) < 0.9)
    for frame_count, expected in ((64, 1 - 0.9**64), (1, 0.1)):
        transmission = Transmission(0, 0, 10**7, mode, 1000 * frame_count, ("flow", 1), 1)
        transmission.powers_mw = [0.0, NOISE_MW * 10 ** (ratio_db / 10)]
        transmission.frame_count = frame_count
        assert decoding_probability(transmission, 1, NOISE_MW) == pytest.approx(expected, abs=0.002)


@pytest.mark.parametrize("mode", [G6, G54, format_modes("HE", "5 GHz", 80, 2, 800)[11]], ids=lambda mode: mode.name)
@pytest.mark.parametrize("size_bytes", [14, 1500, 11_454])
def test_certain_ratios_enclose_all_other_errors(mode: WifiMode, size_bytes: int) -> None:
    never, always = (10 * math.log10(ratio) for ratio in certain_ratios(mode, size_bytes.bit_length()))
    correction_db = 10 * math.log10(mode.width_mhz / 20)
    assert packet_error(mode, never - correction_db - 0.001, size_bytes) > 1 - 1.1e-6
    assert packet_error(mode, always - correction_db + 0.001, size_bytes) < 1.1e-6
    assert always - never < 12, "few frames need a random draw"


# ns-3 3.37, 802.11a: `benchmarks.radio_vs_ns3`. At 15 dB, ns-3 receives the stronger of two simultaneous frames.
@pytest.mark.parametrize(
    ("between_db", "ns3_mbit_s", "tolerance"),
    [(52.0, (12.5, 12.8), 0.06), (15.0, (11.7, 15.3), 0.1), (8.0, (17.5, 8.2), 0.06)],
)
def test_eifs_divides_the_channel_as_in_ns3(
    between_db: float, ns3_mbit_s: tuple[float, float], tolerance: float
) -> None:
    assert pair_goodputs_mbit_s(between_db) == pytest.approx(ns3_mbit_s, rel=tolerance)


def pair_goodputs_mbit_s(between_db: float, *, seconds: float = 3.0) -> list[float]:
    """Return the goodputs of two pairs whose senders are saturated; the second pair receives the first one weaker."""
    ratios_db = dict.fromkeys((first + second for first in "abcd" for second in "abcd" if first != second), 52.0)
    ratios_db |= dict.fromkeys(("ac", "ad", "bc", "bd"), between_db)
    channel = Powers("abcd", ratios_db, OFDM_MODES["5 GHz"][-1])
    channel.band = BANDS["5 GHz"]
    wifi: Wifi[str] = Wifi(channel, 1)
    receivers, arrived = {"a": "b", "c": "d"}, dict.fromkeys("ac", 0)
    for source, receiver in receivers.items():
        for _ in range(20):
            wifi.send(0, source, source, 1000 + HEADERS_BYTES, receiver)
    now_ns = 0
    while now_ns < seconds * 1e9:
        now_ns = wifi.next_event_ns() or now_ns
        arrivals: list[Delivery[str]] = wifi.deliveries(now_ns)
        for _, _, source, _, _ in arrivals:
            arrived[source] += 1
            wifi.send(now_ns, source, source, 1000 + HEADERS_BYTES, receivers[source])
    return [count * 8e-3 / seconds for count in arrived.values()]
