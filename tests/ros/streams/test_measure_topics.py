"""Columns of topics compared with closed forms and manual counts."""

import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import IP, UDP, fragment

from fieldkit.measure.captures.packets import Packets
from fieldkit.ros.streams import topic_columns
from fieldkit.ros.streams.topic_columns import TopicTraffic
from fieldkit.ros.streams.topic_samples import TopicLog, TopicSamples
from tests.helpers.captures import RECEIVER, SENDER, Frame, datagram, ipv4, packets

MS = 1_000_000
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
DATA, DISCOVERY = 17911, 17900
OTHER_DATA = 18161
FLOW = TopicTraffic(SENDER, RECEIVER, frozenset({DATA}), frozenset({DISCOVERY}), deadline_s=0.15)
EVERY = 100 * MS


def log(sequence: Sequence[int], at_ns: Sequence[int], **changes: int | None) -> TopicLog:
    sent_ns = np.array([START + EVERY * number for number in sequence], dtype=np.int64)
    samples = TopicSamples(
        np.array(sequence, dtype=np.int64),
        np.full(len(sequence), 100, dtype=np.int64),
        sent_ns,
        np.array(at_ns, dtype=np.int64),
    )
    times: dict[str, int | None] = {"discovery_start_ns": START - SECOND, "matched_ns": START - SECOND // 2}
    counts = {"refused": 0, "skipped": 0, "foreign": 0}
    return TopicLog(samples, is_complete=True, **{**times, **counts, **changes})  # type: ignore[arg-type]


def publisher_log(count: int) -> TopicLog:
    return log(range(count), [START + EVERY * number for number in range(count)])


def subscriber_log(sequence: Sequence[int], delay_ns: int = 2 * MS, ahead_ns: int = 0) -> TopicLog:
    return log(sequence, [START + EVERY * number + delay_ns + ahead_ns for number in sequence])


def captures(ahead_ns: int = 0, one_way_ns: int = MS // 100) -> tuple[Packets, Packets]:
    """The captures of ten echo requests and their replies; the receiver's clock is ahead by `ahead_ns`."""
    publisher, subscriber = [], []
    for number in range(10):
        at_ns = START + number * EVERY
        request, reply = (
            ipv4(bytes([8 - 8 * back, 0, 0, 0, 0, 1, 0, number]), protocol=1, ip_id=number, src=src, dst=dst)
            for back, src, dst in ((0, SENDER, RECEIVER), (1, RECEIVER, SENDER))
        )
        publisher += [Frame(at_ns, request), Frame(at_ns + 2 * one_way_ns, reply)]
        subscriber += [
            Frame(at_ns + one_way_ns + ahead_ns, request),
            Frame(at_ns + one_way_ns + ahead_ns, reply),
        ]
    return packets(publisher), packets(subscriber)


def measure(sent: TopicLog, received: TopicLog, *captured: Packets | None) -> dict[str, object]:
    result = topic_columns.measure(
        FLOW, sent, received, *(captured or (None, None))
    ) | topic_columns.measure_withheld("")
    assert result.values.keys() | result.missing.keys() == {column.name for column in topic_columns.COLUMNS}
    return dict(result.values)


@given(st.sets(st.integers(0, 49)), st.lists(st.integers(0, 49), max_size=5))
def test_losses_are_samples_that_never_arrived(lost: set[int], again: list[int]) -> None:
    arrived_numbers = [number for number in range(50) if number not in lost]
    repeated_numbers = [number for number in again if number not in lost]
    result = measure(publisher_log(50), subscriber_log([*arrived_numbers, *repeated_numbers]))
    assert (result["topic_sent"], result["topic_received"]) == (50, 50 - len(lost))
    assert result["topic_loss"] == pytest.approx(len(lost) / 50)
    assert result["topic_repeated"] == len(repeated_numbers)


@pytest.mark.parametrize(
    ("lost", "median_s", "p95_s"), [(0, 2e-3, 2e-3), (2, 2e-3, 2e-3), (3, 2e-3, None), (25, None, None)]
)
def test_a_lost_sample_counts_as_the_latest_in_the_delays_of_all_sent_samples(
    lost: int, median_s: float | None, p95_s: float | None
) -> None:
    result = measure(publisher_log(50), subscriber_log(range(lost, 50)), *captures())
    assert result["topic_delay_median_s"] == pytest.approx(2e-3, rel=1e-3)
    for name, expected in (("median", median_s), ("p95", p95_s)):
        value = result.get(f"topic_delay_{name}_sent_s")
        assert value == (None if expected is None else pytest.approx(expected, rel=1e-3))


def test_discovery_is_timed_by_the_publishers_clock() -> None:
    assert measure(publisher_log(3), subscriber_log([0, 1, 2]))["topic_discovery_s"] == 0.5


def test_failed_discovery_is_a_measurement() -> None:
    unmatched_log = replace(log([], []), matched_ns=None)
    result = measure(unmatched_log, log([], []))
    assert result == {
        "topic_sent": 0,
        "topic_received": 0,
        "topic_repeated": 0,
        "topic_refused": 0,
        "topic_skipped": 0,
        "topic_discovered": False,
        "topic_deadline_misses": 0,
    }


@pytest.mark.parametrize("ahead_ns", [0, 5 * SECOND, -3600 * SECOND])
def test_delays_are_corrected_for_the_clock_offset(ahead_ns: int) -> None:
    result = measure(publisher_log(10), subscriber_log(range(10), 2 * MS, ahead_ns), *captures(ahead_ns))
    assert result["topic_delay_median_s"] == pytest.approx(2e-3, abs=1e-5)
    assert result["topic_delay_max_s"] == pytest.approx(2e-3, abs=1e-5)
    assert result["topic_delay_error_s"] == pytest.approx(1.1e-5, rel=0.5)
    assert result["topic_delay_variation_p95_s"] == 0
    assert result["topic_jitter_s"] == 0
    # With evenly spaced samples and a constant delay, the mean age is half a period plus the delay, and the peak is a
    # whole period plus the delay.
    assert result["topic_age_mean_s"] == pytest.approx(0.05 + 2e-3, abs=1e-5)
    assert result["topic_age_peak_s"] == pytest.approx(0.1 + 2e-3, abs=1e-5)


def test_a_delay_below_the_clock_error_is_withheld() -> None:
    result = measure(publisher_log(10), subscriber_log(range(10), 2 * MS), *captures(one_way_ns=MS))
    assert "topic_delay_median_s" not in result
    assert result["topic_delay_error_s"] == pytest.approx(1e-3, rel=0.1)
    assert result["topic_age_mean_s"] == pytest.approx(0.052, abs=1e-3)


def test_with_a_single_packet_from_the_receiver_there_is_no_delay() -> None:
    """No other packet confirms its time, so the error of the clock offset is unlimited."""
    publisher, subscriber = captures()
    back = np.flatnonzero(publisher.are_from(FLOW.receiver_address))
    publisher = publisher.where(np.setdiff1d(np.arange(len(publisher)), back[1:]))
    result = measure(publisher_log(10), subscriber_log(range(10), 2 * MS), publisher, subscriber)
    assert not {name for name in result if "delay_m" in name or "error" in name or "age" in name}
    assert result["topic_delay_variation_p95_s"] == 0


def test_without_captures_there_is_no_delay() -> None:
    result = measure(publisher_log(10), subscriber_log(range(10)))
    assert not {name for name in result if "delay_m" in name or "age" in name}
    assert result["topic_jitter_s"] == 0


def test_late_and_reordered_samples_do_not_reduce_the_age() -> None:
    """The samples are sent at 0, 1, 2 and 3 s. The third overtakes the second, which then does not reduce the age."""
    at_s, delay_s = np.array([0.5, 2.5, 2.75, 3.5]), np.array([0.5, 0.5, 1.75, 0.5])
    mean_s, peak_s = topic_columns.age_s(at_s, delay_s)
    # The age rises from 0.5 to 2.5 in 2 s, drops to 0.5 and rises to 1.5 in 1 s.
    assert mean_s == pytest.approx(((0.5 + 2.5) / 2 * 2 + (0.5 + 1.5) / 2 * 1) / 3)
    assert peak_s == pytest.approx((2.5 + 1.5) / 2)


@given(st.lists(st.floats(0.01, 3), min_size=2, max_size=40), st.lists(st.floats(0.001, 5), min_size=40, max_size=40))
def test_the_mean_age_is_the_area_under_the_sawtooth(gaps: list[float], delays: list[float]) -> None:
    at_s = np.cumsum(gaps)
    delay_s = np.array(delays[: len(gaps)])
    mean_s, _ = topic_columns.age_s(at_s, delay_s)
    if mean_s is None:
        return
    # The age at a time is the time since the newest arrived sample was sent.
    newest_s = np.maximum.accumulate(at_s - delay_s)
    fresh = np.concatenate(([True], newest_s[1:] > newest_s[:-1]))
    moments = np.linspace(at_s[0], at_s[fresh][-1], 20_001)[:-1] + (at_s[fresh][-1] - at_s[0]) / 40_000
    ages = moments - newest_s[np.searchsorted(at_s, moments, side="right") - 1]
    assert mean_s == pytest.approx(float(ages.mean()), rel=2e-2, abs=2e-3)


@pytest.mark.parametrize(
    ("at_ms", "missed"),
    [([0, 100, 200], 0), ([0, 150], 0), ([0, 151], 1), ([0, 300, 350], 1), ([0, 460], 3), ([0], 0)],
)
def test_each_deadline_without_a_sample_is_missed(at_ms: list[int], missed: int) -> None:
    assert topic_columns.deadline_misses(np.array(at_ms, dtype=np.int64) * MS, 0.15) == missed


def test_traffic_is_identified_by_its_ports() -> None:
    data = [datagram(1, 100, port=DATA), datagram(2, 100, port=DATA, sport=DISCOVERY), datagram(3, 3000, port=DATA)]
    discovery = [datagram(4, 60, port=DISCOVERY), datagram(5, 60, port=DISCOVERY, sport=DATA)]
    others = [datagram(6, 60), [ipv4(bytes(8), protocol=1, ip_id=7)], [ipv4(b"", protocol=1, size=99, offset=1480)]]
    frames = [Frame(START, packet) for group in (*data, *discovery, *others) for packet in group]
    result = measure(publisher_log(2), subscriber_log([0, 1]), packets(frames), packets(frames))
    # 3,008 bytes of UDP are three fragments.
    assert (result["topic_data_packets"], result["topic_discovery_packets"]) == (5, 2)
    sizes = sum(len(packet) for group in discovery for packet in group)
    assert result["topic_discovery_bytes"] == sizes


def test_data_packets_missing_at_the_subscriber_are_lost() -> None:
    """Each fragment is counted separately; packets of replies and of the discovery are not data packets."""
    data = [packet for number in (1, 2) for packet in datagram(number, 3000, port=DATA)]
    others = [*datagram(3, 60, port=DISCOVERY), ipv4(bytes(8), protocol=17, ip_id=4, src=RECEIVER, dst=SENDER)]
    sent_frames = [Frame(START + number * MS, packet) for number, packet in enumerate((*data, *others))]
    lost = [1, 5, 6]
    received_frames = [frame for number, frame in enumerate(sent_frames) if number not in lost]
    assert len(data) == 6
    result = measure(publisher_log(2), subscriber_log([0]), packets(sent_frames), packets(received_frames))
    assert result["topic_packet_loss"] == pytest.approx(2 / 6)


def test_without_udp_packets_there_is_no_packet_loss() -> None:
    assert "topic_packet_loss" not in measure(publisher_log(2), subscriber_log([0]), *captures())


@pytest.mark.parametrize("seed", range(12))
def test_two_streams_of_one_pair_have_separate_fragments(seed: int) -> None:
    """scapy fragments the datagrams; ids repeat in both streams, in replies and in unfragmented packets."""
    draw = random.Random(seed)
    fragments_by_port: list[tuple[int, list[IP]]] = []
    for number in range(30):
        port, size = draw.choice([DATA, OTHER_DATA]), draw.choice([100, 3000, 9000])
        src, dst = (SENDER, RECEIVER) if draw.random() < 0.8 else (RECEIVER, SENDER)
        expected = (
            IP(src=src, dst=dst, id=number % 3)
            / UDP(sport=port, dport=port)
            / bytes(draw.randrange(256) for _ in range(size))
        )
        fragments_by_port.append((port, fragment(expected, 1480)))  # type: ignore[no-untyped-call]
        if draw.random() < 0.3:  # this packet is between two fragments of the last datagram
            unfragmented = IP(src=SENDER, dst=RECEIVER, id=number % 3, flags="DF") / UDP(
                sport=OTHER_DATA, dport=OTHER_DATA
            )
            fragments_by_port[-1:] = [
                (port, fragments_by_port[-1][1][:1]),
                (OTHER_DATA, [unfragmented]),
                (port, fragments_by_port[-1][1][1:]),
            ]
    sent = [
        (START + MS * at, *packet)
        for at, packet in enumerate((port, packet) for port, fragments in fragments_by_port for packet in fragments)
    ]
    received = [packet for packet in sent if draw.random() < 0.8]
    publisher, subscriber = (
        packets(Frame(at_ns, bytes(packet)) for at_ns, _, packet in capture) for capture in (sent, received)
    )
    for port in (DATA, OTHER_DATA):
        flow = replace(FLOW, data_ports=frozenset({port}))
        result = topic_columns.measure(flow, None, None, publisher, subscriber).values
        data = [packet for _, packet_port, packet in sent if packet_port == port]
        assert result["topic_data_packets"] == len(data)
        assert result["topic_data_bytes"] == sum(map(len, data))
        sent_data, received_data = (
            [packet for _, packet_port, packet in capture if packet_port == port and packet.src == SENDER]
            for capture in (sent, received)
        )
        assert result["topic_packet_loss"] == pytest.approx(1 - len(received_data) / len(sent_data))


def test_only_columns_that_need_the_captures_are_withheld() -> None:
    without_captures = topic_columns.measure(FLOW, publisher_log(10), subscriber_log(range(10)), None, None)
    reasons = topic_columns.withheld_reasons(without_captures, "packets were dropped")
    assert set(reasons) == without_captures.missing.keys() - {"topic_deadline_misses"}
    assert set(reasons.values()) == {"packets were dropped"}
    assert without_captures.values.keys() >= {"topic_loss", "topic_jitter_s", "topic_delay_variation_p95_s"}
    assert topic_columns.withheld_reasons(without_captures, "") == {}
    assert topic_columns.measure_withheld("packets were dropped").values == {
        "topic_capture_withheld": "packets were dropped"
    }
