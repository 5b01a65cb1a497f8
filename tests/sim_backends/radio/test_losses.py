"""Losses reported by radio models: each addressed station of a packet is reported once, as delivery or as loss."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_backends.radio.antennas import Antenna
from sim_backends.radio.core.links import (
    LOST,
    NOT_DECODED,
    OUT_OF_RANGE,
    QUEUE_FULL,
    RADIO_OFF,
    RETRIES_EXHAUSTED,
)
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.models.radio_model import RadioModel, WifiInWorld
from sim_backends.radio.phy.modes import G_MODES, SHORT_RETRY_LIMIT
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.wifi import Wifi
from tests.helpers.nightly import examples
from tests.helpers.stations import FixedPowers

MS = 1_000_000
NAMES = "abcr"
ANTENNA = Antenna("802.11g", 15.0, -85.0)
G54 = G_MODES[-1]
FIXED = st.fixed_dictionaries(
    {
        "loss": st.sampled_from(["0%", "30%"]),
        "delay": st.sampled_from(["0ms", "1ms"]),
        "rate": st.sampled_from(["unlimited", "10Mbit/s"]),
        "queue_packets": st.integers(0, 4),
    }
)
WIFI = st.fixed_dictionaries({"queue_packets": st.integers(0, 4)})
EVENTS = st.lists(
    st.tuples(
        st.integers(0, 20 * MS),
        st.one_of(
            st.tuples(st.sampled_from(NAMES), st.sampled_from([None, *NAMES]), st.integers(20, 1500)),
            st.tuples(
                st.frozensets(st.sampled_from(NAMES), max_size=2),
                st.frozensets(st.tuples(st.sampled_from("ab"), st.sampled_from("cr")), max_size=2),
            ),
        ),
    ),
    min_size=10,
    max_size=60,
).map(lambda events: sorted(events, key=lambda event: event[0]))


@settings(max_examples=examples(150))
@given(
    WIFI | FIXED,
    st.integers(0, 100),
    st.fixed_dictionaries(dict.fromkeys(NAMES, st.tuples(st.floats(0, 70), st.floats(0, 70), st.just(1.0)))),
    EVENTS,
    st.sampled_from([None, "r"]),
)
def test_each_receiver_of_a_packet_is_reported_exactly_once(
    options: dict[str, str | int],
    seed: int,
    places_m: dict[str, tuple[float, float, float]],
    events: list[tuple[int, tuple[str, str | None, int] | tuple[frozenset[str], frozenset[tuple[str, str]]]]],
    relay: str | None,
) -> None:
    radio_options = RadioOptions.model_validate(options)
    model: RadioModel[int] = (
        UniformLinks(seed, radio_options)
        if radio_options.is_fixed
        else WifiInWorld(seed, radio_options, dict.fromkeys(NAMES, ANTENNA), None)
    )
    reports: Counter[tuple[int, str]] = Counter()
    model.log_losses(lambda _, number, name, __: reports.update([(number, name)]))
    model.place(0, places_m, relay)
    sent_packets: set[tuple[int, str]] = set()
    stations_off: frozenset[str] = frozenset()
    for number, (at_ns, event) in enumerate(events):
        if len(event) == 2:
            stations_off, cut_links = event
            model.disturb(at_ns, stations_off, cut_links)
            continue
        source, destination, size_bytes = event
        if source in stations_off or source == destination:
            continue
        sent_packets |= {(number, name) for name in (destination or NAMES) if name != source}
        model.send(at_ns, source, number, size_bytes, destination)
    reports.update((number, name) for _, name, number, _, _ in model.deliveries(10**12))
    assert model.next_event_ns() is None
    assert reports == Counter(sent_packets)


def record_losses(wifi: Wifi[int]) -> list[tuple[int, str, str]]:
    losses: list[tuple[int, str, str]] = []
    wifi.log_losses(lambda _, number, name, reason: losses.append((number, name, reason)))
    return losses


def test_exhausted_retries_are_reported_at_the_sender_and_the_relay() -> None:
    for missing_link, losing_station in ((("a", "r"), "a"), (("r", "b"), "r")):
        wifi: Wifi[int] = Wifi(FixedPowers("abr", G54, without_link=[missing_link]), 1)
        wifi.set_relay("r")
        losses = record_losses(wifi)
        wifi.send(0, "a", 1, 100, "b")
        assert wifi.deliveries(10**9) == []
        assert losses == [(1, "b", RETRIES_EXHAUSTED)], losing_station


def test_a_frame_whose_acks_are_lost_is_delivered_and_not_lost() -> None:
    channel = FixedPowers("ab", G54)
    channel.rows[1][0] = 0.0
    wifi: Wifi[int] = Wifi(channel, 1)
    losses, attempts = record_losses(wifi), Counter[int]()
    wifi.log_attempts(lambda attempt: attempts.update([attempt.number]))
    wifi.send(0, "a", 1, 100, "b")
    assert [payload for _, _, payload, _, _ in wifi.deliveries(10**9)] == [1]
    assert attempts[SHORT_RETRY_LIMIT] == 1, "all retries were made"
    assert losses == []


def test_queue_drops_and_undecoded_broadcasts_are_reported() -> None:
    channel = FixedPowers("abc", G54, without_link=[("a", "c")])
    wifi: Wifi[int] = Wifi(channel, 1, queue_packets=1)
    losses = record_losses(wifi)
    for number in range(3):
        wifi.send(0, "a", number, 100, None)
    wifi.deliveries(10**9)
    assert losses == [(2, "b", QUEUE_FULL), (2, "c", QUEUE_FULL), (0, "c", NOT_DECODED), (1, "c", NOT_DECODED)]


def test_a_radio_that_is_switched_off_loses_its_queue_and_current_frame() -> None:
    wifi: Wifi[int] = Wifi(FixedPowers("ab", G54), 1)
    losses, decoded_by = record_losses(wifi), list[tuple[str, ...]]()
    wifi.log_attempts(lambda attempt: decoded_by.append(attempt.received))
    for number in range(3):
        wifi.send(0, "a", number, 1500, "b")
    wifi.switch_off(1000, {"a"})
    assert wifi.deliveries(10**9) == []
    assert losses == [(number, "b", RADIO_OFF) for number in range(3)]
    assert decoded_by == [()], "the transmission is aborted"
    wifi.switch_off(10**9, set())
    wifi.send(10**9, "a", 3, 1500, "b")
    assert [payload for _, _, payload, _, _ in wifi.deliveries(2 * 10**9)] == [3]


@pytest.mark.parametrize(
    ("options", "reason"), [({"loss": "100%"}, LOST), ({"queue_packets": 0, "rate": "8bit/s"}, QUEUE_FULL)]
)
def test_fixed_links_report_the_reason(options: dict[str, str | int], reason: str) -> None:
    links: UniformLinks[int] = UniformLinks(1, RadioOptions.model_validate(options))
    links.place(0, dict.fromkeys("ab", (0.0, 0.0, 0.0)), None)
    losses: list[tuple[int, str, str]] = []
    links.log_losses(lambda at_ns, number, name, reason: losses.append((at_ns, name, reason)))
    links.send(5, "a", 1, 100, "b")
    links.send(7, "a", 2, 100, "b")
    assert losses[-1] == (7, "b", reason)


def test_switching_off_a_radio_loses_queued_packets_of_fixed_links_but_not_those_in_flight() -> None:
    links: UniformLinks[int] = UniformLinks(1, RadioOptions.model_validate({"rate": "12Mbit/s", "delay": "5ms"}))
    links.place(0, dict.fromkeys("ab", (0.0, 0.0, 0.0)), None)
    losses: list[tuple[int, int, str]] = []
    links.log_losses(lambda at_ns, number, _, reason: losses.append((at_ns, number, reason)))
    # Each packet takes 1 ms to send; at 2.5 ms two have left and the third is being sent.
    for number in range(4):
        links.send(0, "a", number, 1500, "b")
    links.disturb(2_500_000, {"a"}, set())
    assert [(at_ns, number) for at_ns, _, number, _, _ in links.deliveries(10**9)] == [(6 * MS, 0), (7 * MS, 1)]
    assert losses == [(2_500_000, 2, RADIO_OFF), (2_500_000, 3, RADIO_OFF)]
    counters = links.counters()["a", "b"]
    assert (counters.sent, counters.lost, counters.delivered) == (4, 2, 2)


def test_the_queue_of_a_fixed_link_is_empty_after_an_outage() -> None:
    links: UniformLinks[int] = UniformLinks(1, RadioOptions.model_validate({"rate": "12Mbit/s", "delay": "5ms"}))
    links.place(0, dict.fromkeys("ab", (0.0, 0.0, 0.0)), None)
    for number in range(4):
        links.send(0, "a", number, 1500, "b")
    links.disturb(500_000, {"a"}, set())
    links.disturb(MS, set(), set())
    links.send(MS, "a", 4, 1500, "b")
    assert [(at_ns, number) for at_ns, _, number, _, _ in links.deliveries(10**9)] == [(7 * MS, 4)]


def test_a_receiver_that_leaves_during_the_first_hop_is_reported() -> None:
    links: UniformLinks[int] = UniformLinks(1, RadioOptions.model_validate({"delay": "5ms", "rate": "unlimited"}))
    links.place(0, dict.fromkeys("abr", (0.0, 0.0, 0.0)), "r")
    losses: list[tuple[int, str, str]] = []
    links.log_losses(lambda at_ns, _, name, reason: losses.append((at_ns, name, reason)))
    links.send(0, "a", 1, 100, "b")
    links.place(MS, dict.fromkeys("ar", (0.0, 0.0, 0.0)), "r")
    assert links.deliveries(10**9) == []
    assert losses == [(5 * MS, "b", OUT_OF_RANGE)]


def test_a_cut_link_is_out_of_range_in_both_directions_until_restored() -> None:
    model: WifiInWorld[int] = WifiInWorld(1, RadioOptions(fading=False), dict.fromkeys("abc", ANTENNA), None)
    model.place(0, {name: (10.0 * number, 0.0, 1.0) for number, name in enumerate("abc")}, None)
    losses: list[tuple[int, str]] = []
    model.log_losses(lambda _, number, __, reason: losses.append((number, reason)))
    model.disturb(0, set(), {("a", "b")})
    for number, (source, destination) in enumerate([("a", "b"), ("b", "a"), ("a", "c"), ("c", "b")]):
        model.send(0, source, number, 100, destination)
    assert sorted(payload for _, _, payload, _, _ in model.deliveries(MS * 100)) == [2, 3]
    assert losses == [(0, OUT_OF_RANGE), (1, OUT_OF_RANGE)]
    model.disturb(MS * 100, set(), set())
    model.send(MS * 100, "a", 4, 100, "b")
    assert [payload for _, _, payload, _, _ in model.deliveries(MS * 200)] == [4]
