"""Contradictions between the logs of a topic and the captures of its ends.

A capture contains the head of most samples: number and time of sending (`topic_samples`). Therefore, each sample in a
log is compared with its packet. Their times are comparable, because both are from one robot's clock. If the capture
contains no heads, because TCP or a middleware put several samples into one packet, counts and bytes are compared.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Value
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import NO_TIME, Floats, Ints, Mask
from fieldkit.measure.captures.headers import UDP
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES
from fieldkit.measure.transfers.delay import LARGEST_ERROR
from fieldkit.measure.transfers.match import match
from fieldkit.ros.streams.sample_arrivals import (
    MAX_LATENCY_FEW_NS,
    MAX_LATENCY_NS,
    MIN_SAMPLES,
    STAMP_NS,
    SampleArrivals,
    seq_difference,
)
from fieldkit.ros.streams.topic_checks import TopicPlan
from fieldkit.ros.streams.topic_columns import first_arrivals
from fieldkit.ros.streams.topic_samples import SampleFlow, SampleHeads, TopicLog, TopicSamples

SLOW_S: Final = 0.02
"""A delay is not reported if the subscriber's program caused more than this time and more than a tenth of the delay,
because a slow program cannot be distinguished from a log with wrong times. On two idle hosts the maximum of 100
delays caused by the program was 0.3 to 13 ms."""

PROGRAM_DELAY_FIGURES: Final = {
    "topic_delay_median_s": "median",
    "topic_delay_mean_s": "mean",
    "topic_delay_p95_s": "95th percentile",
    "topic_delay_max_s": "largest",
    "topic_delay_error_s": "mean",
    "topic_delay_median_sent_s": "median of those sent",
    "topic_delay_p95_sent_s": "95th percentile of those sent",
    "topic_age_mean_s": "mean",
    "topic_age_peak_s": "mean",
    "topic_delay_variation_p95_s": "95th percentile",
    "topic_jitter_s": "95th percentile",
    "topic_deadline_misses": "largest",
}
"""Columns of times. Each is compared with this statistic of the delay in the subscriber's program; for
`topic_deadline_misses`, the deadline is compared."""

_GRACE_NS: Final = 300_000_000
"""The subscriber's log may lack samples that were captured within this time of the discovery of the publisher, or of
the end of the log."""


_READ_BURST_NS: Final = 1_000_000
"""Time in which a subscriber's program reads all samples in its queue."""

_OVERHEAD_BYTES: Final = 200
_OVERHEAD_ONCE_BYTES: Final = 20_000
"""Largest overhead of a middleware over TCP: for each sample, and once for all of them."""


@dataclass(frozen=True, eq=False)
class CapturedTopic:
    """A topic in both captures.

    Attributes:
        publisher: Packets in the publisher's capture; None without a complete capture.
        subscriber: Packets in the subscriber's capture; None without a complete capture.
        complete: True if its data are sent over UDP, and all packets that were sent are in the subscriber's capture.
    """

    publisher: SampleFlow | None
    subscriber: SampleFlow | None
    complete: bool


def is_complete(publisher: SampleFlow, subscriber: SampleFlow) -> bool:
    """Return True if the publisher sent UDP packets of the topic, and all are in the subscriber's capture."""
    sent_packets, received_packets = (
        flow.packets.where(flow.packets.protocol == UDP) for flow in (publisher, subscriber)
    )
    return len(sent_packets) > 0 and bool(match(sent_packets, received_packets).arrived.all())


def check_captures(
    plan: TopicPlan, publisher_log: TopicLog, subscriber_log: TopicLog, captured: CapturedTopic
) -> Iterator[str]:
    """Yield each contradiction between the logs and the captures as a sentence.

    Args:
        plan: Settings of the procedure.
        publisher_log: Complete log of the publisher.
        subscriber_log: Complete log of the subscriber.
        captured: The topic in both captures.
    """
    # A capture in which packets lack a time cannot be compared with a log.
    if any(
        flow is not None and (flow.packets.time_ns == NO_TIME).any()
        for flow in (captured.publisher, captured.subscriber)
    ):
        return
    if captured.publisher is not None:
        yield from _content_contradictions(
            captured.publisher.heads, publisher_log.samples, publisher_log.samples.sequence, "publisher"
        )
        yield from _sending_contradictions(captured.publisher.heads)
    if captured.subscriber is not None:
        yield from _content_contradictions(captured.subscriber.heads, subscriber_log.samples, None, "subscriber")
        yield from _arrival_contradictions(plan, subscriber_log, captured.subscriber, complete=captured.complete)


def _arrival_contradictions(
    plan: TopicPlan, subscriber_log: TopicLog, subscriber: SampleFlow, *, complete: bool
) -> Iterator[str]:
    """Yield the contradictions between the subscriber's log and its capture."""
    arrivals = first_arrivals(subscriber_log)
    yield from SampleArrivals.of(arrivals, subscriber, complete=complete, reliable=plan.reliable).contradictions()
    yield from _surplus_copies(subscriber_log.samples, subscriber)
    yield from _uncaptured_samples(plan, arrivals, subscriber)
    if missing_count := _missing_count(plan, subscriber_log, subscriber, complete=complete):
        missing_text = format_count(missing_count, "sample")
        yield f"the subscriber's log lacks {missing_text} that arrived according to its capture"


def withheld_columns(
    values: Mapping[str, Value],
    arrivals: TopicSamples,
    captured: CapturedTopic,
    *,
    reliable: bool,
    deadline_s: float | None,
) -> dict[str, str]:
    """Return a reason for each time column that the delay of the subscriber's program distorts too much.

    Args:
        values: Columns of the topic from the logs.
        arrivals: Samples that arrived, each once.
        captured: The topic in both captures.
        reliable: Whether samples are retransmitted until they arrive.
        deadline_s: Deadline of the topic; None if it has no deadline.
    """
    if captured.subscriber is None or not len(arrivals):
        return {}
    latency_s = SampleArrivals.of(
        arrivals, captured.subscriber, complete=captured.complete, reliable=reliable
    ).latency_s
    if latency_s is None or not len(latency_s):
        return {}
    # A sample of unknown latency affects the columns, too. It is assumed to have the largest known latency.
    latency_s = np.append(latency_s, np.full(len(arrivals) - len(latency_s), latency_s.max()))
    figures_s = {
        "median": float(np.median(latency_s)),
        "mean": float(latency_s.mean()),
        "95th percentile": float(np.percentile(latency_s, 95)),
        "largest": float(latency_s.max()),
        "median of those sent": _quantile_of_sent(latency_s, values, 0.5),
        "95th percentile of those sent": _quantile_of_sent(latency_s, values, 0.95),
    }
    reasons = {}
    for name, figure in PROGRAM_DELAY_FIGURES.items():
        value = deadline_s if name == "topic_deadline_misses" else values.get(name)
        if name in values and isinstance(value, float) and figures_s[figure] > max(SLOW_S, LARGEST_ERROR * value):
            late_text = f"the subscriber's log is later than its capture by {figures_s[figure]:.3f} s"
            reasons[name] = f"{late_text} ({figure}): its program was delayed, or the log is wrong"
    return reasons


def _quantile_of_sent(latency_s: Floats, values: Mapping[str, Value], share: float) -> float:
    """Return the quantile of the received samples that corresponds to this quantile of the sent samples."""
    sent_count, received_count = values.get("topic_sent"), values.get("topic_received")
    if isinstance(sent_count, int) and isinstance(received_count, int) and received_count:
        sent_per_received = sent_count / received_count
    else:
        sent_per_received = 1.0
    return float(np.quantile(latency_s, min(share * sent_per_received, 1.0)))


def _content_contradictions(
    heads: SampleHeads, samples: TopicSamples, numbers: Ints | None, name: str
) -> Iterator[str]:
    """Yield contradictions between the heads in a capture and the log of the same robot.

    Args:
        heads: Heads of samples in the capture.
        samples: Samples in the log. Their times of sending must be those in the heads.
        numbers: Numbers of the samples in the log, if it must contain every captured sample; otherwise None.
        name: `publisher` or `subscriber`.
    """
    if numbers is not None and (unlogged_count := int((~np.isin(heads.sequence, numbers)).sum())):
        yield f"the {name}'s log lacks {format_count(unlogged_count, 'sample')} of its capture"
    first_heads = heads.first()
    _, log_index, capture_index = np.intersect1d(samples.sequence, first_heads.sequence, return_indices=True)
    if different_count := int((samples.sent_ns[log_index] != first_heads.sent_ns[capture_index]).sum()):
        samples_text = format_count(different_count, "sample")
        yield f"{samples_text} with different times of sending in the {name}'s log and in its capture"


def _sending_contradictions(publisher: SampleHeads) -> Iterator[str]:
    """Yield contradictions between the times of sending and the publisher's capture."""
    first_heads = publisher.first()
    after_ns = first_heads.at_ns - first_heads.sent_ns
    if len(after_ns) and int(after_ns.min()) < -STAMP_NS:
        early_s = -int(after_ns.min()) / 1e9
        yield f"a sample was sent {early_s:.6f} s before it was created, according to the publisher's capture and log"
    if len(after_ns) > 2 and after_ns.min() > (
        MAX_LATENCY_NS if len(after_ns) >= MIN_SAMPLES else MAX_LATENCY_FEW_NS
    ):
        late_s = int(after_ns.min()) / 1e9
        late_text = f"every sample was sent {late_s:.6f} s or more after it was created"
        yield f"{late_text}, according to the publisher's capture and log"


def _surplus_copies(samples: TopicSamples, subscriber: SampleFlow) -> Iterator[str]:
    """Yield a contradiction if a log contains samples more often than the capture does."""
    numbers, copies = np.unique(samples.sequence, return_counts=True)
    captured_numbers, captured_copies = np.unique(subscriber.heads.sequence, return_counts=True)
    is_captured = np.isin(numbers, captured_numbers)
    max_copies = np.ones(len(numbers), dtype=np.int64)
    if not subscriber.is_tcp:  # TCP delivers every byte once, even if it arrived several times
        max_copies[is_captured] = captured_copies[np.searchsorted(captured_numbers, numbers[is_captured])]
    if surplus := int(((copies > max_copies) & (is_captured | subscriber.is_tcp)).sum()):
        yield f"the subscriber's log has {format_count(surplus, 'sample')} more often than its capture"


def _uncaptured_samples(plan: TopicPlan, arrivals: TopicSamples, subscriber: SampleFlow) -> Iterator[str]:
    """Yield a contradiction if the capture has too few packets for the samples in a log without duplicates."""
    # Without the expected ports and without heads, the packets of the topic are unknown.
    if not plan.uses_expected_ports and not len(subscriber.heads):
        return
    packets = subscriber.packets
    size_bytes = plan.size_bytes + plan.envelope_bytes
    headless_count = int((~np.isin(arrivals.sequence, subscriber.heads.sequence)).sum())
    payload_bytes = packets.tcp_payload_bytes + np.maximum(packets.udp_bytes - UDP_HEADER_BYTES, 0)
    # `capacity` is the number of samples without a captured head that fit into the captured bytes.
    if subscriber.is_tcp or size_bytes > _MAX_UNDIVIDED_BYTES:
        capacity = int(payload_bytes.sum()) // size_bytes - len(subscriber.heads.first())
    else:
        capacity = int((payload_bytes // size_bytes).sum()) - len(subscriber.heads)
    if headless_count > max(capacity, 0):
        missing_text = format_count(headless_count - max(capacity, 0), "sample")
        yield f"the subscriber's capture lacks {missing_text} of its log"
    if not len(subscriber.heads):
        yield from _early_samples(arrivals, packets.time_ns, payload_bytes, size_bytes)


_MAX_UNDIVIDED_BYTES: Final = 1_200
"""A DDS sample larger than this may be divided into several messages, each smaller than the sample."""


def _early_samples(samples: TopicSamples, times_ns: Ints, payload_bytes: Ints, size_bytes: int) -> Iterator[str]:
    """Yield a contradiction if samples were logged before enough bytes had arrived; for captures without heads."""
    order, arrivals_ns = np.argsort(times_ns, kind="stable"), np.sort(samples.at_ns)
    bytes_until = np.concatenate(([0], np.cumsum(payload_bytes[order])))
    captured_bytes = bytes_until[np.searchsorted(times_ns[order], arrivals_ns + STAMP_NS, side="right")]
    needed_bytes = size_bytes * np.arange(1, len(arrivals_ns) + 1)
    if early_count := int((captured_bytes < needed_bytes).sum()):
        early_text = f"{format_count(early_count, 'sample')} in the subscriber's log"
        yield f"{early_text} arrived earlier than the bytes in its capture"


def _missing_count(plan: TopicPlan, log: TopicLog, subscriber: SampleFlow, *, complete: bool) -> int:
    """Return the number of samples that arrived completely but are missing in the log without a known reason.

    Known reasons: the subscriber had not discovered the publisher; its queue overflowed, because its program did not
    read the samples in time; an earlier sample was missing, or a later one had arrived.
    """
    if not len(subscriber.heads):
        return _missing_bytes(plan, log, subscriber)
    heads = subscriber.heads.first()
    start_ns = int(log.times_ns[-1] if log.matched_ns is None else log.matched_ns)
    is_settled = (heads.at_ns > start_ns + _GRACE_NS) & (heads.at_ns < log.times_ns[-1] - _GRACE_NS)
    is_received = _is_received(plan, heads, log.samples, subscriber, complete=complete)
    is_missing = is_settled & is_received & ~np.isin(heads.sequence, log.samples.sequence)
    if not is_missing.any():
        return 0
    return int((~_may_have_overflowed(plan, log.samples, heads, is_missing, int(log.times_ns[-1]))).sum())


def _is_received(
    plan: TopicPlan, heads: SampleHeads, samples: TopicSamples, subscriber: SampleFlow, *, complete: bool
) -> Mask:
    """Return a mask of the samples in `heads` that the subscriber's middleware must have delivered."""
    if subscriber.is_tcp:
        return _is_acknowledged(heads, subscriber)
    has_all_bytes = heads.is_complete | complete
    if plan.reliable:
        # No sample is delivered after a gap. If a later sample was delivered after this one had arrived, there was no
        # gap before it, so this one was delivered, too.
        gapless = np.logical_and.accumulate(heads.sequence == np.arange(len(heads)))
        numbers, first = np.unique(samples.sequence, return_index=True)
        next_index = np.searchsorted(numbers, heads.sequence, side="right")
        next_ns = np.append(samples.at_ns[first], -1)[next_index]
        return has_all_bytes & (gapless | (next_ns >= heads.at_ns))
    # A best-effort sample that arrives after a later one may be dropped.
    is_delivered: Mask = has_all_bytes & (heads.at_ns >= np.maximum.accumulate(heads.at_ns))
    return is_delivered


def _is_acknowledged(heads: SampleHeads, subscriber: SampleFlow) -> Mask:
    """Return a mask of the samples in `heads` that the subscriber's kernel acknowledged completely over TCP."""
    connection = subscriber.connection()
    if connection is None or not len(connection[1]):
        return np.zeros(len(heads), dtype=np.bool_)
    base = int(heads.end[0])
    is_acknowledged: Mask = seq_difference(heads.end, base) <= seq_difference(connection[1].tcp_ack, base).max()
    return is_acknowledged


def _may_have_overflowed(
    plan: TopicPlan, samples: TopicSamples, heads: SampleHeads, is_missing: Mask, end_ns: int
) -> Mask:
    """Return a mask of the missing samples of `heads` that a queue of the subscriber may have dropped."""
    if plan.depth is None:
        return np.zeros(int(is_missing.sum()), dtype=np.bool_)
    arrived_ns, read_ns = np.sort(heads.at_ns), np.append(np.sort(samples.at_ns), end_ns)
    lost_ns = heads.at_ns[is_missing]
    next_ns = read_ns[np.minimum(np.searchsorted(read_ns, lost_ns), len(read_ns) - 1)]
    queue_length = np.searchsorted(arrived_ns, next_ns, side="right") - np.searchsorted(
        arrived_ns, lost_ns, side="right"
    )
    # When a missing sample arrives, all samples that waited for it are read together. Some of their heads may be
    # missing in the capture, so the reads are counted, too.
    read_together = np.searchsorted(read_ns[:-1], next_ns + _READ_BURST_NS, side="right") - np.searchsorted(
        read_ns[:-1], next_ns
    )
    queue_length = np.maximum(queue_length, read_together)
    # A queue drops a sample only if at least `depth` samples arrive after it, or are read together with it.
    newest_ns = arrived_ns[max(len(arrived_ns) - plan.depth, 0)]
    may_have_overflowed: Mask = (queue_length >= plan.depth) & ((lost_ns < newest_ns) | (read_together >= plan.depth))
    return may_have_overflowed


def _missing_bytes(plan: TopicPlan, log: TopicLog, subscriber: SampleFlow) -> int:
    """Return the number of samples that a log lacks, from the TCP bytes that arrived; for captures without heads."""
    if not subscriber.is_tcp:
        return 0
    max_bytes = plan.size_bytes + plan.envelope_bytes + _OVERHEAD_BYTES
    payload = subscriber.packets.where(subscriber.packets.tcp_payload_bytes > 0)
    _, first = np.unique(payload.tcp_seq, return_index=True)
    arrived_bytes = int(payload.tcp_payload_bytes[first].sum()) - _OVERHEAD_ONCE_BYTES
    return max(arrived_bytes // max_bytes - len(log.samples), 0)
