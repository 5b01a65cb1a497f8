"""Stalls of transfers, from captures with given gaps."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import stalls, tcp, udp
from fieldkit.measure.transfers.deliveries import FlowSchedule, StreamDeliveries
from tests.helpers.captures import transfer
from tests.helpers.streams import MS, SECOND, START, Stream, captured

UNKNOWN = FlowSchedule()
TCP, UDP = transfer(Protocol.TCP), transfer(Protocol.UDP)
STEP_NS = 10 * MS


def tcp_deliveries(sender: Packets, receiver: Packets, schedule: FlowSchedule = UNKNOWN) -> list[StreamDeliveries]:
    return stalls.tcp_deliveries(tcp.match_transfer(sender, receiver, TCP), TCP.backward(sender), schedule)


def udp_deliveries(sender: Packets, receiver: Packets, schedule: FlowSchedule = UNKNOWN) -> list[StreamDeliveries]:
    return stalls.udp_deliveries(udp.match_transfer(sender, receiver, UDP), schedule)


def measure_values(deliveries: list[StreamDeliveries]) -> dict[str, Any]:
    values = stalls.measure("transfer", lambda: deliveries).values
    assert ("transfer_stall_s" in values) is not ("transfer_stall_at_least_s" in values), (
        "there is a value or a lower bound"
    )
    return {name.removeprefix("transfer_"): value for name, value in values.items()}


def steady_connection(count: int, *, period_ns: int = STEP_NS) -> Stream:
    """Return a connection that delivers a segment every `period_ns`."""
    stream = Stream()
    stream.handshake()
    for number in range(count):
        stream.segment(number, 5 * MS + number * period_ns)
    return stream


@given(
    gaps_ms=st.lists(st.integers(1, 3000), min_size=1, max_size=20),
    copies=st.integers(0, 2),
    offload=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_the_longest_stall_is_the_longest_gap_despite_retransmissions(
    gaps_ms: list[int], copies: int, offload: bool
) -> None:
    stream = Stream()
    stream.handshake()
    at_ns, arrived_ns, segments = 5 * MS, [], 3 if offload else 1
    for number, gap_ms in enumerate([0, *gaps_ms]):
        at_ns += gap_ms * MS
        stream.segment(number * segments, at_ns, segments=segments)
        arrived_ns.append(at_ns)
        for copy in range(1, copies + 1):  # copies of delivered segments, within the following gap
            stream.segment(number * segments, at_ns + copy * MS // 4, segments=segments)
    result = measure_values(tcp_deliveries(*captured([stream])))
    gaps_between_ms = [(later - earlier) / MS for earlier, later in pairwise(arrived_ns)]
    assert result["stall_s"] == pytest.approx(max(gaps_between_ms) / 1e3, abs=1e-6)
    assert result["stalls"] == sum(duration_ms > 200 for duration_ms in gaps_between_ms)


@given(st.integers(200, 5000), st.integers(1, 30))
@settings(max_examples=25, deadline=None)
def test_segments_after_a_gap_do_not_end_a_stall(hole_ms: int, n_later_segments: int) -> None:
    stream = steady_connection(10)
    begin_ns = 5 * MS + 10 * STEP_NS
    stream.segment(10, begin_ns, arrives=False)
    for number in range(n_later_segments):
        stream.segment(11 + number, begin_ns + (number + 1) * MS)
    stream.segment(10, begin_ns + hole_ms * MS)
    result = measure_values(tcp_deliveries(*captured([stream])))
    assert result["stall_s"] == pytest.approx(hole_ms / 1e3 + STEP_NS / SECOND, abs=1e-6)
    assert result["stalls"] == 1


def test_nothing_is_delivered_after_a_gap_that_is_never_filled() -> None:
    stream = steady_connection(10)
    begin_ns = 5 * MS + 10 * STEP_NS
    stream.segment(10, begin_ns, arrives=False)
    for number in range(50):
        stream.segment(11 + number, begin_ns + (number + 1) * STEP_NS)
    result = measure_values(tcp_deliveries(*captured([stream])))
    assert result == {"stall_at_least_s": pytest.approx(0.51, abs=1e-6), "stalls": 1}


def test_a_stream_without_a_stall_has_its_longest_gap_and_no_stall() -> None:
    result = measure_values(tcp_deliveries(*captured([steady_connection(50)])))
    assert result == {"stall_s": pytest.approx(0.01, abs=1e-6), "stalls": 0}


def test_a_stall_that_lasts_until_the_listener_ended_is_a_lower_bound() -> None:
    stream = steady_connection(10)
    last_ns = 5 * MS + 9 * STEP_NS
    for retransmission_ns in (200 * MS, 600 * MS, 1400 * MS):
        stream.segment(10, last_ns + retransmission_ns, arrives=False)
    ended_ns = START + last_ns + 5 * SECOND
    schedule = FlowSchedule(size_bytes=20_000, receiver_end_ns=ended_ns)
    result = measure_values(tcp_deliveries(*captured([stream]), schedule))
    assert result == {"stall_at_least_s": pytest.approx(5.0 - stream.delay_ns / SECOND, abs=1e-6), "stalls": 1}
    # Without the end of its program, the stall lasts until the sender's last packet.
    result = measure_values(tcp_deliveries(*captured([stream])))
    assert result == {"stall_at_least_s": pytest.approx(1.4, abs=1e-6), "stalls": 1}


def test_a_file_that_is_complete_does_not_stall_until_its_listener_ends() -> None:
    schedule = FlowSchedule(size_bytes=10_000, receiver_end_ns=START + 30 * SECOND)
    assert measure_values(tcp_deliveries(*captured([steady_connection(10)]), schedule)) == {
        "stall_s": pytest.approx(0.01, abs=1e-6),
        "stalls": 0,
    }


def test_a_connection_that_was_set_up_late_has_stalled() -> None:
    stream = Stream()
    stream.handshake(3 * SECOND, lost=(0, SECOND))
    for number in range(10):
        stream.segment(number, 3 * SECOND + 5 * MS + number * STEP_NS)
    result = measure_values(tcp_deliveries(*captured([stream])))
    assert result == {"stall_s": pytest.approx(3.005, abs=1e-6), "stalls": 1}


def test_a_connection_that_is_never_established_has_a_lower_bound() -> None:
    stream = Stream()
    for at_ns in (0, SECOND, 3 * SECOND, 7 * SECOND):
        stream.forward(at_ns, 0, "S", arrives=False)
    result = measure_values(tcp_deliveries(*captured([stream])))
    assert result == {"stall_at_least_s": pytest.approx(7.0), "stalls": 1}


def test_data_that_never_arrives_has_a_lower_bound() -> None:
    stream = Stream()
    for number in range(100):
        stream.datagram(number, number * STEP_NS, arrives=False)
    result = measure_values(udp_deliveries(*captured([stream])))
    assert result == {"stall_at_least_s": pytest.approx(0.99), "stalls": 1}


@given(st.sets(st.integers(1, 98), max_size=90), st.integers(0, 1))
@settings(max_examples=40, deadline=None)
def test_lost_datagrams_are_a_gap_with_and_without_fragmentation(lost_numbers: set[int], fragments: int) -> None:
    stream = Stream()
    size = 1000 if not fragments else 4000
    for number in range(100):
        stream.datagram(number, number * STEP_NS, size=size, arrives=number not in lost_numbers)
    result = measure_values(udp_deliveries(*captured([stream])))
    arrived_numbers = sorted(set(range(100)) - lost_numbers)
    gaps_s = [(later - earlier) * 0.01 for earlier, later in pairwise(arrived_numbers)]
    assert result["stall_s"] == pytest.approx(max(gaps_s), abs=1e-5)
    assert result["stalls"] == sum(gap_s > 0.2001 for gap_s in gaps_s)


@pytest.mark.parametrize("last_arrived", [60, 95])
def test_the_end_of_a_flow_counts_if_it_is_longer_than_the_minimum_stall(last_arrived: int) -> None:
    stream = Stream()
    for number in range(100):
        stream.datagram(number, number * STEP_NS, arrives=number <= last_arrived)
    result = measure_values(udp_deliveries(*captured([stream])))
    if last_arrived == 95:
        assert result == {"stall_s": pytest.approx(0.01), "stalls": 0}, (
            "four lost datagrams are a loss, but not a stall"
        )
    else:
        assert result == {"stall_at_least_s": pytest.approx(0.39), "stalls": 1}


def test_pauses_of_a_flow_with_a_fixed_rate_are_not_stalls() -> None:
    stream = Stream()
    for number in range(10):
        stream.datagram(number, number * SECOND, arrives=number not in {4, 5})
    one_per_second = FlowSchedule(interval_s=1.0)
    result = measure_values(udp_deliveries(*captured([stream]), one_per_second))
    assert result == {"stall_s": pytest.approx(2.0), "stalls": 0}, (
        "two consecutive lost datagrams are a loss, but not a stall"
    )
    stream = Stream()
    for number in range(10):
        stream.datagram(number, number * SECOND)
    assert measure_values(udp_deliveries(*captured([stream]), one_per_second)) == {"stall_s": 0.0, "stalls": 0}


def test_a_flow_shorter_than_its_schedule_has_stalled_until_the_end_of_the_schedule() -> None:
    stream = Stream()
    for number in range(100):  # after 1 s the interface of the sender is down
        stream.datagram(number, number * STEP_NS)
    scheduled = FlowSchedule(interval_s=0.01, duration_s=5.0)
    assert measure_values(udp_deliveries(*captured([stream]), scheduled)) == {
        "stall_at_least_s": pytest.approx(4.0),
        "stalls": 1,
    }
    shortened = replace(scheduled, receiver_end_ns=START + 3 * SECOND)
    assert measure_values(udp_deliveries(*captured([stream]), shortened))["stall_at_least_s"] == pytest.approx(
        2.0, abs=0.01
    )


@pytest.mark.parametrize("ahead_ns", [-3600 * SECOND, 86_400 * SECOND])
def test_an_offset_between_the_clocks_does_not_change_stalls(ahead_ns: int) -> None:
    stream = Stream(ahead_ns=ahead_ns)
    stream.handshake(SECOND, lost=(0,))
    for number in range(20):
        stream.segment(number, SECOND + 5 * MS + number * STEP_NS)
    stream.segment(20, 2 * SECOND, arrives=False)
    result = measure_values(tcp_deliveries(*captured([stream])))
    assert result == {"stall_at_least_s": pytest.approx(1.005, abs=1e-6), "stalls": 2}


def test_a_clock_that_is_set_back_is_rejected() -> None:
    stream = steady_connection(20)
    at_receiver = captured([stream])[1]
    times_ns = at_receiver.time_ns.copy()
    times_ns[10:] -= SECOND
    with_clock_step = replace(at_receiver, time_ns=times_ns)
    with pytest.raises(EvidenceError, match="set back"):
        tcp_deliveries(captured([stream])[0], with_clock_step)


def test_extreme_times_do_not_overflow() -> None:
    stream = steady_connection(20)
    at_sender, at_receiver = captured([stream])
    times_ns = at_receiver.time_ns.copy()
    times_ns[-1] = 2**63 - 1
    result = measure_values(tcp_deliveries(at_sender, replace(at_receiver, time_ns=times_ns)))
    assert result["stall_s"] > 7e9


def test_stalls_of_connections_are_counted_separately() -> None:
    steady_stream, slow_stream = steady_connection(100), Stream(sport=40001)
    slow_stream.handshake()
    for number in range(10):
        slow_stream.segment(number, 5 * MS + number * 300 * MS)
    result = measure_values(tcp_deliveries(*captured([steady_stream, slow_stream])))
    assert result == {"stall_s": pytest.approx(0.3), "stalls": 9}


def test_empty_captures_give_empty_columns(tmp_path: Path) -> None:
    empty_captures = captured([])
    for deliveries in (lambda: udp_deliveries(*empty_captures), lambda: tcp_deliveries(*empty_captures)):
        result = stalls.measure("transfer", deliveries)
        assert not result.values
        assert result.missing.keys() == {column.name for column in stalls.declare_columns("transfer", "it", 0)}
