"""Access categories compared with ns-3 and with an independent simulation of slots; DSCPs; internal collisions."""

from collections.abc import Sequence
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typing_extensions import override

from fieldkit.config.wifi_phy import DscpMapping
from sim_backends.radio.mac.aggregation import AMPDU_LIMITS, AmpduLimits
from sim_backends.radio.mac.edca import BACKGROUND, BEST_EFFORT, VIDEO, VOICE, category_of
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.phy.high_throughput import format_modes
from sim_backends.radio.phy.modes import G_MODES, SLOT_NS, response_ns
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import FixedPowers

HT20_7 = format_modes("HT", "2.4 GHz", 20, 1, 800)[7]
BAND = HT20_7.band
SUBFRAME_BYTES = 1072
DSCP = {BEST_EFFORT: 0, BACKGROUND: 8, VIDEO: 40, VOICE: 48}
# AIFSN, CWmin, CWmax, TXOP limit in ns: table 9-155 for OFDM, limits of IEEE 802.11-2012 (as in Linux and ns-3).
TABLE = {
    BACKGROUND: (7, 15, 1023, 0),
    BEST_EFFORT: (3, 15, 1023, 0),
    VIDEO: (2, 7, 15, 3_008_000),
    VOICE: (2, 3, 7, 1_504_000),
}


class CategorizedPowers(FixedPowers):
    """Stations with access categories and aggregation."""

    @override
    def dscp_mapping(self, station: int) -> DscpMapping | None:
        return "linux"

    @override
    def ampdu_limits(self, transmitter: int, receiver: int) -> AmpduLimits:
        return AMPDU_LIMITS["HT"]


def goodputs(categories: Sequence[int], *, seconds: float, in_one_station: bool = False) -> list[float]:
    """Return goodput in Mbit/s of a saturated station per category, or of one station with all categories."""
    names = ["s0" if in_one_station else f"s{number}" for number in range(len(categories))]
    wifi: Wifi[int] = Wifi(CategorizedPowers([*dict.fromkeys(names), "r"], HT20_7), 1)
    arrival_counts = [0] * len(categories)
    queued_categories = [number for number in range(len(categories)) for _ in range(120)]
    wifi.log_losses(lambda _, number, *rest: queued_categories.append(number))
    now_ns: int | None = 0
    while now_ns is not None and now_ns < seconds * 1e9:
        for _, _, number, _, _ in wifi.deliveries(now_ns):
            arrival_counts[number] += 1
            queued_categories.append(number)
        for number in queued_categories:
            wifi.send(now_ns, names[number], number, 1028, "r", dscp=DSCP[categories[number]])
        queued_categories.clear()
        now_ns = wifi.next_event_ns()
    return [count * 8e-3 / seconds for count in arrival_counts]


def simulate_slots(categories: Sequence[int], *, seconds: float) -> list[float]:
    """Return goodput in Mbit/s of saturated stations, one per category, from backoff counters only (10.23.2.4)."""
    random = Random(1)
    answer_ns = BAND.sifs_ns + response_ns(HT20_7, 32)
    frames, airtimes_ns = [], []
    for category in categories:
        limit_ns = min(TABLE[category][3] - answer_ns if TABLE[category][3] else 5_484_000, 5_484_000)
        count = max(n for n in range(1, 65) if HT20_7.airtime_ns(n * SUBFRAME_BYTES - 2) <= limit_ns)
        frames.append(count)
        airtimes_ns.append(HT20_7.airtime_ns(count * SUBFRAME_BYTES - 2))
    window = [TABLE[category][1] for category in categories]
    slots = [random.randint(0, size) for size in window]
    aifs_ns = [BAND.sifs_ns + TABLE[category][0] * SLOT_NS for category in categories]
    count_start_ns, delivered_counts, now_ns = list(aifs_ns), [0] * len(categories), 0
    while now_ns < seconds * 1e9:
        starts_ns = [begin + count * SLOT_NS for begin, count in zip(count_start_ns, slots, strict=True)]
        now_ns = min(starts_ns)
        senders = [number for number, start_ns in enumerate(starts_ns) if start_ns - now_ns <= 4_000]
        end_ns = max(starts_ns[number] + airtimes_ns[number] for number in senders)
        channel_end_ns = end_ns + (answer_ns if len(senders) == 1 else 0)
        for number, category in enumerate(categories):
            if number not in senders:
                slots[number] -= min(max(now_ns - count_start_ns[number], 0) // SLOT_NS, slots[number])
                count_start_ns[number] = channel_end_ns + aifs_ns[number]
                continue
            _, min_window, max_window, _ = TABLE[category]
            delivered_counts[number] += frames[number] * (len(senders) == 1)
            window[number] = min_window if len(senders) == 1 else min(2 * window[number] + 1, max_window)
            slots[number] = random.randint(0, window[number])
            timeout_ns = starts_ns[number] + airtimes_ns[number] + BAND.sifs_ns + SLOT_NS + 20_000
            begin_ns = channel_end_ns + aifs_ns[number]
            count_start_ns[number] = begin_ns if len(senders) == 1 else max(begin_ns, timeout_ns)
    return [count * 8e-3 / seconds for count in delivered_counts]


@pytest.mark.parametrize(
    "categories",
    [
        (BEST_EFFORT, BACKGROUND),
        (BEST_EFFORT, VIDEO),
        (VIDEO, VOICE),
        (BEST_EFFORT, BACKGROUND, VIDEO, VOICE),
    ],
)
def test_saturated_categories_share_the_channel_like_their_slots(categories: Sequence[int]) -> None:
    expected = simulate_slots(categories, seconds=30.0)
    assert goodputs(categories, seconds=3.0) == pytest.approx(expected, rel=0.07, abs=3.0)


# ns-3 3.37: `benchmarks.high_throughput_vs_ns3`, one or two stations in one category.
@pytest.mark.parametrize(
    ("categories", "ns3_mbit_s"),
    [
        ((BACKGROUND,), 58.18),
        ((VIDEO,), 58.38),
        ((VOICE,), 56.82),
        ((VIDEO, VIDEO), 52.95),
        ((VOICE, VOICE), 45.24),
    ],
)
def test_goodput_of_a_category_is_within_five_percent_of_ns3(categories: Sequence[int], ns3_mbit_s: float) -> None:
    assert sum(goodputs(categories, seconds=1.0)) == pytest.approx(ns3_mbit_s, rel=0.05)


def test_categories_of_one_station_contend_with_each_other() -> None:
    """An internal collision costs no airtime: voice has at least the goodput that it has beside another station."""
    best_effort, voice = goodputs((BEST_EFFORT, VOICE), seconds=2.0, in_one_station=True)
    assert voice > 10 * best_effort
    assert best_effort + voice > 50


def test_a_transmission_opportunity_has_several_exchanges_of_single_frames() -> None:
    """Frames of 1064 bytes take 212 us with ACK at 54 Mbit/s: 1.504 ms contain 6 of them, SIFS apart."""

    class Single(CategorizedPowers):
        @override
        def ampdu_limits(self, transmitter: int, receiver: int) -> None:  # type: ignore[override]
            return None

    wifi: Wifi[int] = Wifi(Single("ar", G_MODES[-1]), 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    for number in range(20):
        wifi.send(0, "a", number, 1028, "r", dscp=DSCP[VOICE])
    assert len(wifi.deliveries(10**9)) == 20
    frames = [attempt for attempt in log if attempt.number]
    acks = [attempt for attempt in log if attempt.control == "ACK"]
    gaps_ns = [later.start_ns - ack.end_ns for ack, later in zip(acks, frames[1:], strict=False)]
    bursts = [1]
    for gap_ns in gaps_ns:
        if gap_ns == BAND.sifs_ns:
            bursts[-1] += 1
        else:
            assert gap_ns >= BAND.sifs_ns + 2 * SLOT_NS
            bursts.append(1)
    exchange_ns = acks[0].end_ns - frames[0].start_ns + BAND.sifs_ns
    assert set(bursts[:-1]) == {(1_504_000 + BAND.sifs_ns) // exchange_ns}


def test_voice_overtakes_queued_best_effort() -> None:
    wifi: Wifi[str] = Wifi(CategorizedPowers("ar", format_modes("HT", "2.4 GHz", 20, 1, 800)[0]), 1)
    for number in range(60):
        wifi.send(0, "a", f"data {number}", 1028, "r")
    wifi.send(1_000_000, "a", "voice", 200, "r", dscp=48)
    payloads = [payload for _, _, payload, _, _ in wifi.deliveries(10**9)]
    assert len(payloads) == 61
    assert payloads.index("voice") <= 5, "after the aggregate of best effort that was on the air"


def test_a_station_switched_off_loses_the_frames_of_all_categories_once() -> None:
    wifi: Wifi[int] = Wifi(CategorizedPowers("ar", HT20_7), 1)
    losses: list[int] = []
    wifi.log_losses(lambda _, payload, *rest: losses.append(payload))
    for number in range(100):
        wifi.send(0, "a", number, 1028, "r", dscp=(0, 8, 40, 48)[number % 4])
    arrived_numbers = [payload for _, _, payload, _, _ in wifi.deliveries(2_000_000)]
    wifi.switch_off(2_000_000, {"a"})
    arrived_numbers += [payload for _, _, payload, _, _ in wifi.deliveries(10**10)]
    assert sorted(arrived_numbers + losses) == list(range(100))


def test_the_counters_of_a_link_include_all_categories() -> None:
    wifi: Wifi[int] = Wifi(CategorizedPowers("ar", HT20_7), 1)
    for number in range(40):
        wifi.send(0, "a", number, 1028, "r", dscp=(0, 8, 40, 48)[number % 4])
    assert len(wifi.deliveries(10**10)) == 40
    assert wifi.counters()["a", "r"].delivered == 40


@pytest.mark.parametrize(
    ("dscp", "linux", "rfc8325"),
    [
        (0, BEST_EFFORT, BEST_EFFORT),
        (8, BACKGROUND, BACKGROUND),
        (10, BACKGROUND, BEST_EFFORT),
        (18, BACKGROUND, BEST_EFFORT),
        (24, BEST_EFFORT, VIDEO),
        (34, VIDEO, VIDEO),
        (40, VIDEO, VIDEO),
        (44, VIDEO, VOICE),
        (46, VIDEO, VOICE),
        (48, VOICE, BEST_EFFORT),
        (56, VOICE, BEST_EFFORT),
    ],
)
def test_dscps_are_mapped_as_by_linux_or_by_rfc_8325(dscp: int, linux: int, rfc8325: int) -> None:
    """Linux up to 6.7: precedence; RFC 8325, figure 1: EF is voice, AF3x video, AF1x best effort, CS1 background."""
    assert (category_of(dscp, "linux"), category_of(dscp, "rfc8325")) == (linux, rfc8325)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3_000_000), st.booleans()), max_size=60))
def test_each_packet_arrives_once_and_in_the_order_of_its_category(packets: list[tuple[int, int, bool]]) -> None:
    wifi: Wifi[tuple[int, int]] = Wifi(CategorizedPowers("abr", HT20_7), 1)
    now_ns, arrived_packets = 0, []
    for number, (category, step_ns, is_first) in enumerate(packets):
        now_ns += step_ns
        arrived_packets += [(source, payload) for _, _, payload, source, _ in wifi.deliveries(now_ns)]
        wifi.send(now_ns, "a" if is_first else "b", (category, number), 500, "r", dscp=DSCP[category])
    arrived_packets += [(source, payload) for _, _, payload, source, _ in wifi.deliveries(now_ns + 10**10)]
    assert len(arrived_packets) == len(packets)
    for source in "ab":
        for category in range(4):
            numbers = [
                number
                for name, (packet_category, number) in arrived_packets
                if (name, packet_category) == (source, category)
            ]
            assert numbers == sorted(numbers)
