"""Contradictions within the JSON of one end of an iperf3 test, and between the JSON of both ends.

Each holds for the versions 3.1.3 to 3.17.1 in both directions, whatever the link loses, duplicates or delays.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.model import Protocol
from fieldkit.measure.evidence.iperf3 import IperfInterval, IperfTest

_ROUNDING_S: Final = 0.002
"""iperf3 prints times with 6 digits, some versions `seconds` with more."""
_ENDS_S: Final = 0.02
"""The last interval and the summary read the clock one after the other."""
_EMPTY_S: Final = 1.1
"""3.17 leaves out a last interval in which nothing came."""
_ROUNDING: Final = 1e-3
_EARLY_S: Final = 0.1
"""A timer of the client may end a test by so much before its duration."""
_WHOLE_SECONDS_S: Final = 2
"""`timesecs` is in whole seconds."""

CROSS_CHECKS: Final = (
    CrossCheck(
        "payload per interval",
        ("iperf3_*_bytes", "iperf3_throughput_bit_s", "iperf3_interval_*"),
        "`ROLE-iperf3.json`: `intervals[].sum`",
        (
            "the same file: `streams`, `bits_per_second`, `end`",
            "the other end's `end`",
            "both captures: payload by then",
            "without captures: the receiver's interface counters",
        ),
        "none within a file; beside captures 0.5 s of traffic and what sockets buffered, because iperf3 counts reads",
    ),
    CrossCheck(
        "datagrams expected and lost",
        ("iperf3_datagrams_*", "iperf3_loss"),
        "receiver's `ROLE-iperf3.json`: `intervals[].sum.packets`, `.lost_packets`",
        ("the same file: `end.sum`", "the sender's `end.sum`", "both captures: datagrams that left and arrived"),
        "datagrams that a socket buffer refused (RcvbufErrors, SndbufErrors), that the sender's queue dropped before "
        "its capture, and those after the end of the test",
    ),
    CrossCheck(
        "which test it is",
        ("iperf3_*",),
        "`ROLE-iperf3.json`: `cookie`, `connected`, `test_start`, `timestamp`",
        ("the other end's", "the procedure", "ports in both captures", "the robot's clock before and after"),
        "2 s, because the time stamp is in whole seconds",
    ),
    CrossCheck(
        "jitter at the end",
        ("iperf3_jitter_s",),
        "receiver's `ROLE-iperf3.json`: `end.sum.jitter_ms`",
        ("the sender's `end.sum.jitter_ms`",),
        "none",
    ),
    CrossCheck(
        "retransmissions",
        ("iperf3_retransmits",),
        "sender's `ROLE-iperf3.json`: `intervals[].sum.retransmits`",
        ("the same file: `end.sum_sent.retransmits`", "the sender's capture: segments sent again"),
        "a factor of 2 and 20 segments: offload joins segments, and the kernel counts handshakes too",
    ),
)


@dataclass(frozen=True)
class IperfOrder:
    """What a procedure asks of iperf3.

    Attributes:
        protocol: Transport protocol.
        streams: Number of parallel streams.
        payload_bytes: Payload of a UDP datagram.
        reverse: Whether the server sends.
        lasts_s: Duration in seconds; None if the size ends the test.
    """

    protocol: Protocol
    streams: int
    payload_bytes: int
    reverse: bool
    lasts_s: float | None


def within(test: IperfTest, *, sends: bool) -> Iterator[str]:
    """Yield the contradictions within the JSON of one end."""
    intervals = test.intervals
    yield from _gaps(intervals)
    for number, interval in enumerate(intervals, 1):
        yield from (f"interval {number} {why}" for why in _of_interval(interval))
    totals = test.totals
    own = (
        ("bytes", totals.sent_bytes if sends else totals.received_bytes, _sum(intervals, "payload_bytes")),
        ("retransmits", totals.retransmits if sends else None, _sum(intervals, "retransmits")),
    )
    for what, total, added in own:
        if total is not None and added is not None and total != added:
            yield f"its intervals have {added} {what} in all, and its summary {total}"
    end_s = intervals[-1].end_s if intervals else None
    if end_s is not None and totals.ends_s and not any(_ends_near(end_s, total_s) for total_s in totals.ends_s):
        yield f"its last interval ends at {end_s:.3f} s, and its summary at {max(totals.ends_s):.3f} s"
    if not sends and test.start.protocol == Protocol.UDP and test.start.block_bytes:
        yield from _datagram_bytes(test, test.start.block_bytes)


def _ends_near(last_s: float, total_s: float) -> bool:
    return -_ENDS_S < total_s - last_s < _EMPTY_S


def _gaps(intervals: tuple[IperfInterval, ...]) -> Iterator[str]:
    """Yield where the next interval does not begin where the one before it ended."""
    before_s = intervals[0].start_s if intervals else None
    if before_s is not None and before_s > _ROUNDING_S:
        yield f"its first interval begins at {before_s:.3f} s"
    for interval in intervals:
        if interval.start_s is not None and before_s is not None and abs(interval.start_s - before_s) > _ROUNDING_S:
            yield f"an interval begins at {interval.start_s:.3f} s, and the one before it ends at {before_s:.3f} s"
        before_s = interval.end_s


def _of_interval(interval: IperfInterval) -> Iterator[str]:
    if interval.start_s is not None and interval.end_s is not None:
        lasted_s = interval.end_s - interval.start_s
        if abs(lasted_s - interval.lasted_s) > _ROUNDING_S:
            yield f"lasts {lasted_s:.3f} s by its ends, and {interval.lasted_s:.3f} s by its length"
    if interval.stream_bytes is not None and interval.stream_bytes != interval.payload_bytes:
        yield f"has {interval.payload_bytes} bytes, and its streams {interval.stream_bytes}"
    rate = interval.rate_bit_s
    if rate is not None and not math.isclose(rate, interval.bit_s, rel_tol=_ROUNDING, abs_tol=8):
        yield f"has {interval.bit_s:.0f} bit/s by its bytes, and says {rate:.0f} bit/s"
    if interval.lost is not None and interval.datagrams is not None and interval.lost > interval.datagrams:
        # A datagram that was late is lost in one interval, and taken off the losses of the next.
        yield f"has {interval.lost} datagrams lost of {interval.datagrams}"


def _datagram_bytes(test: IperfTest, payload_bytes: int) -> Iterator[str]:
    """Yield whether the bytes received are not those of the datagrams received; duplicates count as bytes alone."""
    datagrams, lost = (_sum(test.intervals, name) for name in ("datagrams", "lost"))
    received_bytes = _sum(test.intervals, "payload_bytes")
    if datagrams is None or lost is None or received_bytes is None:
        return
    extra = received_bytes - (datagrams - lost) * payload_bytes
    if not 0 <= extra <= test.totals.out_of_order * payload_bytes:
        counted = f"{datagrams} datagrams of {payload_bytes} bytes less {lost} lost"
        yield f"it received {received_bytes} bytes, and counts {counted}"


def between(client: IperfTest, server: IperfTest, order: IperfOrder) -> Iterator[str]:
    """Yield the contradictions between the JSON of both ends, and what a procedure asked of them."""
    if client.start.cookie != server.start.cookie:
        yield "client and server have different cookies: they are two tests"
        return
    if set(client.ports) != {(own, other) for other, own in server.ports}:
        yield "client and server name different ports"
    for name, test in (("client", client), ("server", server)):
        yield from (f"the {name} {why}" for why in _not_as_ordered(test, order))
    lasted_s = sum(interval.lasted_s for interval in client.intervals)
    if order.lasts_s is not None and client.intervals and lasted_s < order.lasts_s - _EARLY_S:
        yield f"the client has intervals of {lasted_s:.1f} s in all, of {order.lasts_s:g} s"
    sender, receiver = (server, client) if order.reverse else (client, server)
    yield from _totals(client, sender, receiver, order)


def _not_as_ordered(test: IperfTest, order: IperfOrder) -> Iterator[str]:
    start = test.start
    asked = {
        "protocol": (start.protocol or None, str(order.protocol)),
        "streams": (start.streams, order.streams),
        "direction": (start.reverse, order.reverse),
        "datagram size": (start.block_bytes, order.payload_bytes if order.protocol is Protocol.UDP else None),
        "number of connections": (len(test.ports), order.streams),
    }
    for what, (has, wanted) in asked.items():
        if has is not None and wanted is not None and has != wanted:
            yield f"had another {what} than the procedure"


def _totals(client: IperfTest, sender: IperfTest, receiver: IperfTest, order: IperfOrder) -> Iterator[str]:
    """Yield where the client's summary, which has the server's results, differs from what each end counted."""
    totals = client.totals
    sent_bytes, received_bytes = _sum(sender.intervals, "payload_bytes"), _sum(receiver.intervals, "payload_bytes")
    if order.protocol is Protocol.TCP and (received_bytes or 0) > (
        sent_bytes if sent_bytes is not None else math.inf
    ):
        yield f"{received_bytes} bytes were received of {sent_bytes} sent"
    counted = (
        ("bytes sent", totals.sent_bytes, (sent_bytes,)),
        ("bytes received", totals.received_bytes, (received_bytes,)),
        # Before 3.8 the only summary may have the sender's count.
        ("datagrams", totals.datagrams, (_sum(receiver.intervals, "datagrams"), _sum(sender.intervals, "datagrams"))),
        ("datagrams lost", totals.lost, (_sum(receiver.intervals, "lost"),)),
    )
    for what, total, seen in counted:
        added = [count for count in seen if count is not None]
        if total is not None and added and total not in added:
            yield f"the client's summary has {total} {what}, and the intervals {added[0]}"
    if order.protocol is Protocol.TCP:
        return
    jitters_s = [test.totals.jitter_s for test in (client, receiver) if test.totals.jitter_s is not None]
    if jitters_s and not math.isclose(jitters_s[0], jitters_s[-1], rel_tol=_ROUNDING, abs_tol=1e-6):
        yield "client and server have different jitters"
    expected, left = _sum(receiver.intervals, "datagrams"), _sum(sender.intervals, "datagrams")
    if expected is not None and left is not None and expected > left:
        yield f"the receiver expected {expected} datagrams, and {left} were sent"


def misdated(test: IperfTest, window: tuple[int, int] | None) -> str | None:
    """Return why a test was not made during the attempt, by the robot's clock before and after it, or None."""
    if window is None or test.start.began_utc_s is None:
        return None
    first_s, last_s = (edge_ns / 1e9 for edge_ns in window)
    began_s = test.start.began_utc_s
    if first_s - _WHOLE_SECONDS_S <= began_s <= last_s + _WHOLE_SECONDS_S:
        return None
    away_s = first_s - began_s if began_s < first_s else began_s - last_s
    return f"it began {away_s:.0f} s {'before' if began_s < first_s else 'after'} the attempt"


def _sum(intervals: tuple[IperfInterval, ...], name: str) -> int | None:
    counts = [getattr(interval, name) for interval in intervals]
    return sum(counts) if counts and None not in counts else None
