"""Requests of a ping over each of several links: the columns are compared with counts over single packets."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.headers import COOKED_V2
from fieldkit.measure.checks import ping_duplicates, ping_links
from fieldkit.measure.checks.ping_links import LinkEnds
from tests.helpers.captures import file_bytes
from tests.measure.checks.test_ping_duplicates import (
    CELL,
    INTERVAL_S,
    REQUEST,
    WIFI,
    Echo,
    capture_echoes,
    echoes_of,
    exchange,
    ping_output,
)

# The sender has the same links on interfaces with other indices.
SENDER_WIFI, SENDER_CELL = 12, 11
LINKS = {"wifi": LinkEnds(SENDER_WIFI, WIFI), "cell-4g": LinkEnds(SENDER_CELL, CELL)}


def requests(*arrivals: tuple[int, int]) -> list[Echo]:
    """Return requests by sequence number and interface."""
    return [Echo(REQUEST, seq, interface) for seq, interface in arrivals]


def test_a_failover_from_one_link_to_another() -> None:
    sent = [(seq, SENDER_WIFI) for seq in range(6)] + [(seq, SENDER_CELL) for seq in range(6, 10)]
    sent += [(seq, SENDER_WIFI) for seq in range(10, 12)]
    arrived = [(seq, WIFI) for seq in range(3)] + [(seq, CELL) for seq in (6, 7, 9)] + [(10, WIFI), (10, CELL)]
    columns = ping_links.measure(LINKS, capture_echoes(*requests(*sent)), capture_echoes(*requests(*arrived)))
    assert columns.values == {
        "rtt_over_wifi_sent": 8,
        "rtt_over_wifi_lost": 4,  # 3 to 5, and 11
        "rtt_over_wifi_duplicates": 0,
        "rtt_over_wifi_failover_s": 1 * INTERVAL_S,
        "rtt_over_cell_4g_sent": 4,
        "rtt_over_cell_4g_lost": 1,
        "rtt_over_cell_4g_duplicates": 1,
        "rtt_over_cell_4g_failover_s": 4 * INTERVAL_S,
    }
    assert not columns.missing


arrivals_of_requests = st.lists(st.tuples(st.integers(0, 6), st.sampled_from([WIFI, CELL])), max_size=25).map(
    lambda arrivals: sorted(arrivals, key=lambda arrival: arrival[0])
)


@given(arrivals_of_requests, st.lists(st.tuples(st.integers(0, 6), st.sampled_from([SENDER_WIFI, SENDER_CELL]))))
def test_columns_equal_counts_over_single_packets(
    arrived: list[tuple[int, int]], sent: list[tuple[int, int]]
) -> None:
    receiver = capture_echoes(*requests(*arrived))
    measured = ping_links.measure(LINKS, capture_echoes(*requests(*sent)), receiver)
    links_by_seq: dict[int, list[int]] = {}
    for seq, interface in arrived:
        links_by_seq.setdefault(seq, []).append(interface)
    firsts = [(seq, interfaces[0]) for seq, interfaces in links_by_seq.items()]
    for link, ends in LINKS.items():
        prefix = f"rtt_over_{link.replace('-', '_')}"
        sent_seqs = {seq for seq, interface in sent if interface == ends.sender}
        assert measured.values[f"{prefix}_sent"] == len(sent_seqs)
        assert measured.values[f"{prefix}_lost"] == len(sent_seqs - links_by_seq.keys())
        assert measured.values[f"{prefix}_duplicates"] == sum(
            ends.receiver in interfaces and interfaces[0] != ends.receiver for interfaces in links_by_seq.values()
        )
        changes_s = [
            (seq - earlier_seq) * INTERVAL_S
            for (earlier_seq, earlier), (seq, interface) in pairwise(firsts)
            if earlier != ends.receiver and interface == ends.receiver
        ]
        assert measured.values.get(f"{prefix}_failover_s") == (pytest.approx(max(changes_s)) if changes_s else None)
    total = sum(int(measured.values[f"rtt_over_{link}_duplicates"]) for link in ("wifi", "cell_4g"))
    assert total == ping_duplicates.count_copies(receiver.requests)


def test_missing_evidence_gives_no_number() -> None:
    capture = capture_echoes(*exchange([1]))
    columns = [column.name for link in LINKS for column in ping_links.declare_columns(link)]
    for sender, receiver in ((None, capture), (capture, None)):
        measured = ping_links.measure(LINKS, sender, receiver)
        assert measured.missing == dict.fromkeys(columns, "a robot has no complete capture around the ping")
        assert not measured.values
    for ends in (LinkEnds(None, WIFI), LinkEnds(SENDER_WIFI, None)):
        measured = ping_links.measure({"wifi": ends}, capture, capture)
        assert not measured.values
        assert all("the interface of the link wifi is unknown" in reason for reason in measured.missing.values())


def test_without_a_change_there_is_no_failover_time() -> None:
    capture = capture_echoes(*requests((1, WIFI), (2, WIFI)))
    measured = ping_links.measure(LINKS, capture, capture)
    assert "no request changed" in measured.missing["rtt_over_wifi_failover_s"]
    assert measured.values["rtt_over_wifi_lost"] == 0


def test_packets_without_a_time_have_no_failover_time() -> None:
    capture = pcap.parse(
        file_bytes([echo.frame() for echo in requests((1, WIFI), (2, CELL))], link_type=COOKED_V2), where="x"
    )
    packets = replace(capture.packets, time_ns=np.full(2, NO_TIME))
    receiver = echoes_of(replace(capture, packets=packets))
    measured = ping_links.measure(LINKS, receiver, receiver)
    assert "have no time" in measured.missing["rtt_over_cell_4g_failover_s"]


def test_an_answered_request_that_did_not_arrive_is_a_contradiction() -> None:
    capture = capture_echoes(*exchange([1, 2]))
    reasons = ping_duplicates.contradictions(ping_output((1, False), (2, False), (3, False)), 0.5, capture, capture)
    assert any("does not contain 1 answered request, the first is request 3" in reason for reason in reasons)
