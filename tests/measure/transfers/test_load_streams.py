"""Stalls and jitter of iperf3 streams, from captures with given gaps and delays."""

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.columns import Measured
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.transfers import delay, iperf3_load, stalls
from fieldkit.measure.transfers.deliveries import FlowSchedule
from fieldkit.measure.transfers.iperf3_load import COOKIE_BYTES, LoadStreams
from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame
from tests.helpers.streams import ISN, MS, SECOND, START, Stream, captured

SCHEDULE = FlowSchedule(interval_s=0.01)
UDP = LoadStreams(Protocol.UDP, SENDER, RECEIVER, PORT, False, 1, 1000, (), SCHEDULE)
TCP = replace(UDP, protocol=Protocol.TCP, schedule=FlowSchedule(head_bytes=COOKIE_BYTES))
LOST = (100, 150)


def measure_values(load: LoadStreams, streams: Iterable[Stream]) -> dict[str, Any]:
    result = iperf3_load.measure_stalls("iperf3", load, *captured(streams))
    assert result.values.keys() | result.missing.keys() == {
        column.name for column in stalls.declare_columns("iperf3", "iperf3", 0)
    }
    return {name.removeprefix("iperf3_"): value for name, value in result.values.items()}


def control(**ends: Any) -> Stream:  # noqa: ANN401 (the fields of Stream)
    """Return the control connection, which is opened first and idle during the test."""
    stream = Stream(**{"sport": 39000, **ends})
    stream.handshake(0)
    for number, at_ns in enumerate((10 * MS, 9 * SECOND)):
        stream.segment(number, at_ns)
        stream.answer(number + 1, at_ns + 5 * MS)
    return stream


def data(sport: int = 40000, lost_numbers: range = range(*LOST)) -> Stream:
    stream = Stream(sport=sport)
    for number in range(400):
        stream.datagram(number, SECOND + number * 10 * MS, arrives=number not in lost_numbers)
    return stream


def test_consecutive_lost_datagrams_are_a_stall() -> None:
    result = measure_values(UDP, [control(), data()])
    assert result == {"stall_s": pytest.approx(0.5), "stalls": 1}


def test_stalls_of_parallel_streams_are_counted_separately() -> None:
    packets = [control(), data(), data(40001, range(200, 300))]
    two_streams = replace(UDP, count=2)
    assert measure_values(two_streams, packets) == {"stall_s": pytest.approx(1.0), "stalls": 2}
    named_stream = replace(UDP, ports=((40000, PORT),))
    assert measure_values(named_stream, packets) == {"stall_s": pytest.approx(0.5), "stalls": 1}


def test_streams_that_cannot_be_distinguished_have_no_stall() -> None:
    assert not measure_values(UDP, [control(), data(), data(40001)])


def test_a_test_longer_than_its_arrivals_has_a_lower_bound() -> None:
    with_duration = replace(UDP, schedule=replace(SCHEDULE, duration_s=10.0))
    assert measure_values(with_duration, [control(), data()]) == {"stall_at_least_s": pytest.approx(6.0), "stalls": 2}


def tcp_data(gap_ns: int) -> Stream:
    """Return a data connection: the cookie of the client, segments, and a gap in which retransmissions are lost."""
    stream = Stream()
    stream.handshake(100 * MS)
    stream.forward(105 * MS, ISN + 1, "PA", b"c" * COOKIE_BYTES)
    data_offset = COOKIE_BYTES
    at_ns = SECOND
    for number in range(100):
        if number == 50:
            for retransmission_ns in range(200 * MS, gap_ns, 400 * MS):
                stream.forward(
                    at_ns + retransmission_ns, ISN + 1 + data_offset + number * 1000, "A", b"x" * 1000, arrives=False
                )
            at_ns += gap_ns
        stream.forward(at_ns, ISN + 1 + data_offset + number * 1000, "A", b"x" * 1000)
        at_ns += 10 * MS
    return stream


@given(st.integers(300, 4000))
@settings(max_examples=15, deadline=None)
def test_retransmissions_that_are_lost_do_not_end_a_stall(gap_ms: int) -> None:
    result = measure_values(TCP, [control(), tcp_data(gap_ms * MS)])
    # The setup is included: 0.9 s from SYN to the first data.
    assert result["stall_s"] == pytest.approx(max(gap_ms / 1e3 + 0.01, 0.9), abs=1e-3)
    assert result["stalls"] == 2


def test_a_reverse_test_sends_from_the_port_of_the_server() -> None:
    data_stream = Stream(sport=PORT, port=40000)
    data_stream.handshake(100 * MS)
    for number in range(100):
        data_stream.forward(
            SECOND + number * 10 * MS + 2 * SECOND * (number >= 50), ISN + 1 + number * 1000, "A", b"x" * 1000
        )
    control_stream = Stream(sport=PORT, port=39000)
    control_stream.handshake(0)
    load = replace(TCP, source_listens=True, schedule=FlowSchedule())
    assert measure_values(load, [control_stream, data_stream])["stall_s"] == pytest.approx(2.01, abs=1e-3)


@pytest.mark.parametrize("end", ["sender", "receiver"])
def test_a_clock_that_is_set_forward_is_not_a_stall(end: str) -> None:
    streams = [control(), data()]
    for stream in streams:
        frames = getattr(stream, end)
        frames[:] = [
            Frame(frame.time_ns + 3600 * SECOND * (frame.time_ns > START + 3 * SECOND), frame.data)
            for frame in frames
        ]
    assert not measure_values(UDP, streams)


@pytest.mark.parametrize("measure", [iperf3_load.measure_jitter, partial(iperf3_load.measure_stalls, "iperf3")])
def test_a_capture_without_times_is_not_regarded_as_a_set_clock(measure: Callable[..., Measured]) -> None:
    sender, receiver = captured([control(), data()])
    result = measure(UDP, sender, replace(receiver, time_ns=np.full(len(receiver), NO_TIME)))
    assert set(result.missing.values()) == {"a capture lacks times"}


def test_a_packet_earlier_than_the_one_before_it_leaves_the_jitter_empty() -> None:
    sender, receiver = captured([control(), data()])
    times_ns = receiver.time_ns.copy()
    times_ns[200] += 50 * MS
    assert iperf3_load.measure_jitter(UDP, sender, replace(receiver, time_ns=times_ns)).values
    times_ns[200] += SECOND
    result = iperf3_load.measure_jitter(UDP, sender, replace(receiver, time_ns=times_ns))
    assert set(result.missing.values()) == {"a packet is earlier than the one before it: a clock was set back"}


def test_without_captures_or_packets_the_columns_are_empty() -> None:
    assert not iperf3_load.measure_stalls("iperf3", UDP, None, captured([data()])[1]).values
    assert not measure_values(UDP, [])
    assert not measure_values(TCP, [control()])


def rfc_3550(transit_s: Sequence[float]) -> float:
    """Return the mean of the estimator as defined in the RFC."""
    jitter_s, jitters_s = 0.0, []
    for before_s, after_s in pairwise(transit_s):
        jitter_s += (abs(after_s - before_s) - jitter_s) / 16
        jitters_s.append(jitter_s)
    return float(np.mean(jitters_s))


@given(st.lists(st.integers(0, 50_000_000), min_size=2, max_size=400))
def test_the_mean_jitter_equals_its_definition(transit_ns: list[int]) -> None:
    result = delay.mean_jitter_s(np.array(transit_ns))
    assert result == pytest.approx(rfc_3550([transit / 1e9 for transit in transit_ns]), abs=1e-12)


def stream_with_delays(delays_ms: Sequence[float], sport: int = 40000) -> Stream:
    stream = Stream(sport=sport)
    for number, delay_ms in enumerate(delays_ms):
        stream.delay_ns = round(delay_ms * MS)
        stream.datagram(number, SECOND + number * 100 * MS)
    return stream


def jitter(load: LoadStreams, streams: Iterable[Stream]) -> dict[str, Any]:
    result = iperf3_load.measure_jitter(load, *captured(streams))
    assert result.values.keys() | result.missing.keys() == {column.name for column in iperf3_load.JITTER}
    return {name.removeprefix("iperf3_captured_"): value for name, value in result.values.items()}


def test_mean_jitter_covers_the_whole_test() -> None:
    noisy_ms = [random.Random(number).uniform(2.0, 20.0) for number in range(60)]
    quiet_ms = [5.0] * 20
    delays_ms = [*noisy_ms, *quiet_ms]
    result = jitter(UDP, [control(), stream_with_delays(delays_ms)])
    assert result["jitter_mean_s"] == pytest.approx(rfc_3550([delay_ms / 1e3 for delay_ms in delays_ms]), rel=1e-3)
    assert result["variation_p95_s"] == pytest.approx((np.percentile(delays_ms, 95) - min(delays_ms)) / 1e3, rel=1e-3)
    last_s = delay.jitter_s(np.array([round(delay_ms * MS) for delay_ms in delays_ms]))
    assert last_s is not None
    assert last_s < 0.5 * result["jitter_mean_s"], "the last value depends mainly on the quiet end"


def test_mean_jitter_of_several_streams_covers_all_datagrams() -> None:
    steady_ms, noisy_ms = [5.0] * 30, [5.0, 15.0] * 15
    result = jitter(
        replace(UDP, count=2), [control(), stream_with_delays(steady_ms), stream_with_delays(noisy_ms, 40001)]
    )
    assert result["jitter_mean_s"] == pytest.approx(rfc_3550([delay_ms / 1e3 for delay_ms in noisy_ms]) / 2, rel=1e-3)


def test_tcp_and_one_way_traffic_have_no_jitter() -> None:
    assert not jitter(TCP, [control(), tcp_data(SECOND)])
    assert not jitter(UDP, [data()])
