"""Round-trip times that ping prints, compared with a capture in which single requests left the kernel late."""

from collections.abc import Sequence

import pytest

from fieldkit.measure.checks.ping_checks import CapturedPing, compare_with_capture
from fieldkit.measure.evidence.ping import Ping, Reply

MS = 1_000_000
START_NS = 1_790_000_000 * 10**9
INTERVAL_NS = 200 * MS
RTT_NS = 3 * MS


def contradictions(waits_ms: Sequence[int], *, excess_ms: Sequence[int] = (), first_seq: int = 1) -> list[str]:
    """Return the contradictions between the output of a ping and the requester's capture.

    Args:
        waits_ms: Time of each request in the kernel before its capture.
        excess_ms: Error of each printed round-trip time; none if empty.
        first_seq: 1, or 0 for busybox.
    """
    requested_ns, replied_ns, replies = {}, {}, []
    for index, (wait_ms, error_ms) in enumerate(zip(waits_ms, excess_ms or [0] * len(waits_ms), strict=True)):
        seq, sent_ns = first_seq + index, START_NS + index * INTERVAL_NS
        requested_ns[seq] = sent_ns + wait_ms * MS
        replied_ns[seq] = requested_ns[seq] + RTT_NS
        rtt_s = (replied_ns[seq] - sent_ns + error_ms * MS) / 1e9
        replies.append(Reply(seq, rtt_s, None, duplicate=False, damaged=False))
    output = Ping(56, tuple(replies), (), len(replies), len(replies), (), first_seq)
    captured = CapturedPing(requested_ns, replied_ns)
    return list(compare_with_capture(output, captured, INTERVAL_NS / 1e9, "sender", is_requester=True))


@pytest.mark.parametrize("waits_ms", [(25,), (1500,), (25, 0), (0, 25), (900, 700, 500, 300, 100, *[0] * 5)])
def test_requests_may_wait_for_the_link_layer_address_of_the_next_hop(waits_ms: Sequence[int]) -> None:
    """The requests leave the kernel together when the address is known."""
    assert not contradictions(waits_ms)


def test_a_request_is_not_sent_before_the_previous_one() -> None:
    """The first request may have been sent at any earlier time."""
    waits_ms = [0] * 5
    assert not contradictions(waits_ms, excess_ms=(210, 0, 190, 0, 0))
    (reason,) = contradictions(waits_ms, excess_ms=(0, 0, 210, 0, 0))
    assert reason == "reply 3 took 213 ms, but 3.000 ms in the sender's capture"


def test_busybox_may_read_a_reply_late() -> None:
    assert not contradictions([0] * 5, excess_ms=(0, 0, 210, 0, 0), first_seq=0)


def test_most_requests_must_not_wait() -> None:
    (reason,) = contradictions((25, 25, 0))
    assert reason == "the median of its times is 25.0 ms longer than in the sender's capture"
