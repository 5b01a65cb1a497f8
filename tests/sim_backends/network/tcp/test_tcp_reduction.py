"""Proportional rate reduction beside RFC 6937, section 3; where it is not said, in segments of one byte."""

import math
from fractions import Fraction

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.tcp.reduction import ProportionalReduction


def test_one_loss_lets_half_as_much_go_as_arrives() -> None:
    # 100 under way of which one is lost, and 50 shall be: every second ACK lets one go.
    reduction, pipe, sent = ProportionalReduction(50, 100, 1), 96, []
    for _ in range(90):
        pipe -= 1
        sent.append(reduction.window_bytes(pipe, 1, safe=False) - pipe)
        reduction.sent(sent[-1])
        pipe += sent[-1]
    assert sent[:8] == [1, 0, 1, 0, 1, 0, 1, 0]
    assert pipe == 51  # 96 - 90 + 45


def test_many_losses_let_go_what_arrives_and_a_safe_ack_one_more() -> None:
    # 60 of 100 are lost: what is under way is below the threshold from the beginning.
    reduction = ProportionalReduction(50, 100, 1)
    assert reduction.window_bytes(37, 1, safe=False) == 38
    reduction.sent(1)
    assert reduction.window_bytes(37, 1, safe=False) == 38
    reduction.sent(1)
    assert reduction.window_bytes(37, 1, safe=True) == 39
    reduction.sent(2)
    # Never beyond the threshold.
    assert reduction.window_bytes(49, 9, safe=True) == 50


@given(st.lists(st.tuples(st.integers(1, 3), st.integers(0, 3)), max_size=80))
def test_no_more_is_sent_than_arrives_while_losses_show(acks: list[tuple[int, int]]) -> None:
    reduction, pipe, sent, arrived = ProportionalReduction(50, 100, 1), 97, 0, 0
    for delivered, lost in acks:
        arrived += delivered
        pipe = max(pipe - delivered - lost, 0)
        more = reduction.window_bytes(pipe, delivered, safe=False) - pipe
        reduction.sent(more)
        pipe, sent = pipe + more, sent + more
        assert 0 <= sent <= arrived


def test_where_as_much_is_under_way_as_shall_be_nothing_more_is_sent() -> None:
    # By the share of what arrived, which holds above the threshold, one would go.
    assert ProportionalReduction(50, 100, 1).window_bytes(50, 1, safe=True) == 50
    assert ProportionalReduction(50, 100, 1).window_bytes(51, 1, safe=True) == 52


def test_who_sent_more_than_arrived_waits_and_takes_nothing_back() -> None:
    for pipe in (60, 40):
        reduction = ProportionalReduction(50, 100, 1)
        reduction.sent(3)
        assert reduction.window_bytes(pipe, 1, safe=False) == pipe


def test_a_safe_ack_lets_a_segment_more_go_than_it_says_has_arrived() -> None:
    """However much was sent before: MAX(prr_delivered - prr_out, DeliveredData) + MSS, in bytes."""
    reduction = ProportionalReduction(50_000, 100_000, 1448)
    reduction.sent(9 * 1448)
    assert reduction.window_bytes(10_000, 2 * 1448, safe=True) == 10_000 + 3 * 1448
    assert reduction.window_bytes(10_000, 2 * 1448, safe=False) == 10_000
    # And with 15 more that arrived, 10 wait to be sent beside the one.
    assert reduction.window_bytes(10_000, 15 * 1448, safe=True) == 10_000 + 16 * 1448
    reduction.sent(5 * 1448)
    assert reduction.window_bytes(10_000, 1448, safe=True) == 10_000 + 7 * 1448


STEPS = st.lists(st.tuples(st.integers(0, 120), st.integers(0, 9), st.booleans(), st.integers(0, 9)), max_size=30)


@given(st.integers(1, 100), st.integers(1, 100), st.integers(1, 5), STEPS)
def test_it_is_what_the_rfc_writes_down(
    threshold: int, flight: int, segment: int, steps: list[tuple[int, int, bool, int]]
) -> None:
    reduction, delivered_so_far, out = ProportionalReduction(threshold, flight, segment), 0, 0
    for pipe, delivered, safe, sent in steps:
        delivered_so_far += delivered
        if pipe > threshold:
            count = math.ceil(Fraction(delivered_so_far * threshold, flight)) - out
        else:
            limit = delivered_so_far - out
            if safe:
                limit = max(limit, delivered) + segment
            count = min(threshold - pipe, limit)
        assert reduction.window_bytes(pipe, delivered, safe=safe) == max(pipe, pipe + count)
        reduction.sent(sent)
        out += sent
