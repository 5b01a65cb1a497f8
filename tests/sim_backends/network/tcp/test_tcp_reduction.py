"""Proportional rate reduction beside RFC 6937, section 3; lengths are in segments of one byte."""

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
