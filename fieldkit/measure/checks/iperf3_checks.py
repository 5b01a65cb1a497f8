"""Contradictions within the JSON of one end of an iperf3 test, and between the JSON of both ends.

The checks are valid for versions 3.1.3 to 3.18 in both directions, with any loss, duplication or delay.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.model import Protocol
from fieldkit.measure.evidence.iperf3 import IperfInterval, IperfTest

_ROUNDING_S: Final = 0.002
"""Tolerance for rounding: iperf3 prints times with 6 digits, and some versions print `seconds` with more."""
_SUMMARY_EARLY_S: Final = 0.02
"""Maximum time by which the end in the summary may be earlier than the end of the last interval. iperf3 reads the
clock for each of them."""
_MAX_OMITTED_S: Final = 1.1
"""Maximum length of a last interval without data, which version 3.17 omits."""
_ROUNDING: Final = 1e-3
"""Relative tolerance for rounding of rates and jitter values."""
_EARLY_S: Final = 0.1
"""Maximum time by which the client's timer may end a test before its full duration."""
_UNCOUNTED_SHARE: Final = 0.01
"""Maximum share of the bytes that the intervals of a version with threads lack, apart from one write per
stream and interval. At 40 Gbit/s they lacked 0.2 %.
"""
_DEFAULT_BLOCK_BYTES: Final = 128 << 10
"""Bytes per write over TCP unless the JSON or `--length` has another value."""
_TIMESTAMP_S: Final = 2
"""Tolerance for start times, because `timesecs` has a resolution of whole seconds."""

CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="payload per interval",
        columns=("iperf3_*_bytes", "iperf3_throughput_bit_s", "iperf3_interval_*"),
        source="`ROLE-iperf3.json`: `intervals[].sum`",
        against=(
            "the same file: `streams`, `bits_per_second`, `end`",
            "the other end's `end`",
            "both captures: payload up to the end of each interval",
            "without captures: the receiver's interface counters",
        ),
        tolerance=(
            "none for bytes in a file (from version 3.16 on: one write per stream and interval, or 1 %), 0.1 % for "
            "rates; compared with the captures, 0.5 s of traffic plus the socket "
            "buffers, because iperf3 counts bytes when it reads them"
        ),
    ),
    CrossCheck(
        quantity="datagrams expected and lost",
        columns=("iperf3_datagrams_*", "iperf3_loss"),
        source="receiver's `ROLE-iperf3.json`: `intervals[].sum.packets`, `.lost_packets`",
        against=("the same file: `end.sum`", "the sender's `end.sum`", "both captures: datagrams sent and received"),
        tolerance=(
            "datagrams dropped at a socket buffer (RcvbufErrors, SndbufErrors) or at the sender's queue before its "
            "capture, and those after the end of the test"
        ),
    ),
    CrossCheck(
        quantity="identity of the test",
        columns=("iperf3_*",),
        source="`ROLE-iperf3.json`: `cookie`, `connected`, `test_start`, `timestamp`",
        against=(
            "the same keys of the other end",
            "the procedure",
            "ports in both captures",
            "the robot's clock before and after",
        ),
        tolerance="start times may differ by 2 s, because the time stamp is in whole seconds",
    ),
    CrossCheck(
        quantity="last jitter value",
        columns=("iperf3_jitter_s",),
        source="receiver's `ROLE-iperf3.json`: `end.sum.jitter_ms`",
        against=("the client's `end.sum.jitter_ms`",),
        tolerance="0.1 %",
    ),
    CrossCheck(
        quantity="retransmissions",
        columns=("iperf3_retransmits",),
        source="sender's `ROLE-iperf3.json`: `intervals[].sum.retransmits`",
        against=("the same file: `end.sum_sent.retransmits`", "the sender's capture: retransmitted segments"),
        tolerance=(
            "the counts may differ by a factor of 2 plus 20 segments: offload joins segments, and the kernel counts "
            "handshakes too"
        ),
    ),
)


@dataclass(frozen=True)
class IperfSettings:
    """Settings of an iperf3 test in a procedure.

    Attributes:
        protocol: Transport protocol.
        streams: Number of parallel streams.
        payload_bytes: Payload of a UDP datagram.
        reverse: True if the server sends.
        duration_s: Duration in seconds; None if the test ends after a number of bytes.
    """

    protocol: Protocol
    streams: int
    payload_bytes: int
    reverse: bool
    duration_s: float | None


def check_one_end(test: IperfTest, *, sends: bool) -> Iterator[str]:
    """Yield the contradictions within the JSON of one end."""
    intervals = test.intervals
    yield from _gaps(intervals)
    for number, interval in enumerate(intervals, 1):
        yield from (f"interval {number} {problem}" for problem in _interval_problems(interval))
    totals = test.totals
    sums = (
        (
            "bytes",
            totals.sent_bytes if sends else totals.received_bytes,
            _sum(intervals, "payload_bytes"),
            _uncounted_bytes(test),
        ),
        ("retransmits", totals.retransmits if sends else None, _sum(intervals, "retransmits"), 0),
    )
    for quantity, total, interval_sum, uncounted in sums:
        if total is not None and interval_sum is not None and not 0 <= total - interval_sum <= uncounted:
            yield f"the sum of {quantity} over its intervals is {interval_sum}, but its summary has {total}"
    end_s = intervals[-1].end_s if intervals else None
    if (
        end_s is not None
        and totals.summary_ends_s
        and not any(_ends_near(end_s, total_s) for total_s in totals.summary_ends_s)
    ):
        yield f"its last interval ends at {end_s:.3f} s, but its summary at {max(totals.summary_ends_s):.3f} s"
    if not sends and test.start.protocol == Protocol.UDP and test.start.block_bytes:
        yield from _datagram_bytes(test, test.start.block_bytes)


def _uncounted_bytes(test: IperfTest) -> int:
    """Return the maximum number of bytes that the intervals of a test lack.

    With threads (`iperf_stats_callback`, version 3.16 and later) the main thread copies the bytes of an interval and
    then sets them to 0, while the thread of the stream adds to them. The total of the test contains all bytes.
    """
    if not test.start.has_threads:
        return 0
    writes = len(test.intervals) * max(1, len(test.ports))
    share_bytes = _UNCOUNTED_SHARE * (_sum(test.intervals, "payload_bytes") or 0)
    return max(writes * (test.start.block_bytes or _DEFAULT_BLOCK_BYTES), int(share_bytes))


def _ends_near(last_s: float, total_s: float) -> bool:
    return -_SUMMARY_EARLY_S < total_s - last_s < _MAX_OMITTED_S


def _gaps(intervals: tuple[IperfInterval, ...]) -> Iterator[str]:
    """Yield a contradiction for each interval that does not start at the end of the previous one.

    The first interval must start at 0.
    """
    previous_end_s = intervals[0].start_s if intervals else None
    if previous_end_s is not None and previous_end_s > _ROUNDING_S:
        yield f"its first interval begins at {previous_end_s:.3f} s"
    for interval in intervals:
        if (
            interval.start_s is not None
            and previous_end_s is not None
            and abs(interval.start_s - previous_end_s) > _ROUNDING_S
        ):
            start = f"an interval begins at {interval.start_s:.3f} s"
            yield f"{start}, but the previous one ends at {previous_end_s:.3f} s"
        previous_end_s = interval.end_s


def _interval_problems(interval: IperfInterval) -> Iterator[str]:
    """Yield the contradictions within an interval, as predicates: `has 100 bytes, but its streams have 90`."""
    if interval.start_s is not None and interval.end_s is not None:
        duration_s = interval.end_s - interval.start_s
        if abs(duration_s - interval.duration_s) > _ROUNDING_S:
            reported = f"{interval.duration_s:.3f} s by its reported duration"
            yield f"lasts {duration_s:.3f} s by its start and end, but {reported}"
    if interval.stream_bytes is not None and interval.stream_bytes != interval.payload_bytes:
        yield f"has {interval.payload_bytes} bytes, but its streams have {interval.stream_bytes}"
    rate = interval.rate_bit_s  # may differ by one byte per second, 8 bit/s, if the interval is almost empty
    if rate is not None and not math.isclose(rate, interval.bit_s, rel_tol=_ROUNDING, abs_tol=8):
        yield f"has {interval.bit_s:.0f} bit/s by its bytes, but reports {rate:.0f} bit/s"
    # A negative loss is possible: a datagram that arrives late is counted as lost in one interval, and
    # subtracted from the losses of the next.
    if interval.lost is not None and interval.datagrams is not None and interval.lost > interval.datagrams:
        yield f"has {interval.lost} of {interval.datagrams} datagrams lost"


def _datagram_bytes(test: IperfTest, payload_bytes: int) -> Iterator[str]:
    """Yield a contradiction if the received bytes do not agree with the received datagrams.

    iperf3 counts duplicates in the bytes and as out of order, but not in the datagrams.
    """
    datagrams, lost = (_sum(test.intervals, name) for name in ("datagrams", "lost"))
    received_bytes = _sum(test.intervals, "payload_bytes")
    if datagrams is None or lost is None or received_bytes is None:
        return
    duplicate_bytes = received_bytes - (datagrams - lost) * payload_bytes
    if not -_uncounted_bytes(test) <= duplicate_bytes <= test.totals.out_of_order * payload_bytes:
        datagrams_text = f"{datagrams} datagrams of {payload_bytes} bytes with {lost} lost"
        yield f"it received {received_bytes} bytes, but counts {datagrams_text}"


def compare_ends(client: IperfTest, server: IperfTest, settings: IperfSettings) -> Iterator[str]:
    """Yield the contradictions between the JSON of both ends, and differences from the procedure's settings."""
    if client.start.cookie != server.start.cookie:
        yield "client and server have different cookies, so they are different tests"
        return
    if set(client.ports) != {(local, remote) for remote, local in server.ports}:
        yield "client and server report different ports"
    for name, test in (("client", client), ("server", server)):
        yield from (f"the {name} {problem}" for problem in _differences(test, settings))
    total_s = sum(interval.duration_s for interval in client.intervals)
    if settings.duration_s is not None and client.intervals and total_s < settings.duration_s - _EARLY_S:
        yield f"the client's intervals last {total_s:.1f} s in total instead of {settings.duration_s:g} s"
    sender, receiver = (server, client) if settings.reverse else (client, server)
    yield from _totals(client, sender, receiver, settings)


def _differences(test: IperfTest, settings: IperfSettings) -> Iterator[str]:
    """Yield the differences between a test and the procedure's settings, as predicates."""
    start = test.start
    comparisons = {
        "protocol": (start.protocol or None, str(settings.protocol)),
        "number of streams": (start.streams, settings.streams),
        "direction": (start.reverse, settings.reverse),
        "datagram size": (start.block_bytes, settings.payload_bytes if settings.protocol is Protocol.UDP else None),
        "number of connections": (len(test.ports), settings.streams),
    }
    for setting, (actual, required) in comparisons.items():
        if actual is not None and required is not None and actual != required:
            yield f"used a different {setting} from the one that the procedure requires"


def _totals(client: IperfTest, sender: IperfTest, receiver: IperfTest, settings: IperfSettings) -> Iterator[str]:
    """Yield differences between the client's summary, which has the server's results, and the counts of both ends."""
    totals = client.totals
    sent_bytes, received_bytes = _sum(sender.intervals, "payload_bytes"), _sum(receiver.intervals, "payload_bytes")
    if (
        settings.protocol is Protocol.TCP
        and sent_bytes is not None
        and received_bytes is not None
        and received_bytes > sent_bytes + _uncounted_bytes(sender)
    ):
        yield f"{received_bytes} bytes were received, but only {sent_bytes} were sent"
    comparisons = (
        ("bytes sent", totals.sent_bytes, (sent_bytes,), _uncounted_bytes(sender)),
        ("bytes received", totals.received_bytes, (received_bytes,), _uncounted_bytes(receiver)),
        # Before version 3.8 there is one summary, which may have the sender's count.
        (
            "datagrams",
            totals.datagrams,
            (_sum(receiver.intervals, "datagrams"), _sum(sender.intervals, "datagrams")),
            0,
        ),
        ("datagrams lost", totals.lost, (_sum(receiver.intervals, "lost"),), 0),
    )
    for quantity, total, candidates, tolerance in comparisons:
        interval_counts = [count for count in candidates if count is not None]
        if (
            total is not None
            and interval_counts
            and not any(0 <= total - count <= tolerance for count in interval_counts)
        ):
            yield f"the client's summary has {total} {quantity}, but the intervals have {interval_counts[0]}"
    if settings.protocol is Protocol.TCP:
        return
    jitters_s = [test.totals.jitter_s for test in (client, receiver) if test.totals.jitter_s is not None]
    if jitters_s and not math.isclose(jitters_s[0], jitters_s[-1], rel_tol=_ROUNDING, abs_tol=1e-6):
        yield "client and server have different jitters"
    expected, sent_datagrams = _sum(receiver.intervals, "datagrams"), _sum(sender.intervals, "datagrams")
    if expected is not None and sent_datagrams is not None and expected > sent_datagrams:
        yield f"the receiver expected {expected} datagrams, but {sent_datagrams} were sent"


def date_problem(test: IperfTest, window: tuple[int, int] | None) -> str | None:
    """Return a sentence if a test began outside of the attempt according to the robot's clock.

    Return None if the test began during the attempt, or if one of the times is unknown.

    Args:
        test: The test.
        window: Readings of the robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if
            unknown.
    """
    if window is None or test.start.start_utc_s is None:
        return None
    first_s, last_s = (edge_ns / 1e9 for edge_ns in window)
    start_s = test.start.start_utc_s
    if first_s - _TIMESTAMP_S <= start_s <= last_s + _TIMESTAMP_S:
        return None
    difference_s = first_s - start_s if start_s < first_s else start_s - last_s
    return f"it began {difference_s:.0f} s {'before' if start_s < first_s else 'after'} the attempt"


def _sum(intervals: tuple[IperfInterval, ...], name: str) -> int | None:
    counts = [getattr(interval, name) for interval in intervals]
    return sum(counts) if counts and None not in counts else None
