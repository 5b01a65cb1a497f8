"""Contradictions between the logs of a topic and the captures of its ends.

A capture shows the head of most samples: number and time of sending (`sample_heads`). So each sample in a log is
compared with its own packet; the clock is the same, since both were written on one robot. What a capture cannot show,
because TCP or a middleware put several samples into one packet, is compared by counts and bytes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Value
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import NO_TIME, Floats, Ints, Mask
from fieldkit.measure.captures.ip import UDP
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES
from fieldkit.measure.checks.topic_checks import TopicPlan
from fieldkit.measure.transfers.delay import LARGEST_ERROR
from fieldkit.measure.transfers.match import match
from fieldkit.measure.transfers.sample_heads import SampleFlow, SampleHeads
from fieldkit.measure.transfers.topic_log import Stamped, TopicLog
from fieldkit.measure.transfers.topics import first_arrivals

STAMP_NS: Final = 2_000
"""tcpdump cuts times off to microseconds, and the kernel may stamp a packet by a clock read 1 us later."""

HANDOVER_NS: Final = 5_000_000
FEW_HANDOVER_NS: Final = 20_000_000
MANY: Final = 20
"""Most time between the packet of a sample and its record, for the fastest sample; the larger one if there are fewer
than `MANY`. A program on a busy robot holds back single samples for longer, but not all of them."""

SLOW_S: Final = 0.02
"""A delay of which the subscriber's program made more than this, and more than a tenth, is withheld: such a program
cannot be distinguished from a log with wrong times. On two idle hosts the largest of 100 was 0.3 to 13 ms."""

MADE: Final = {
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
"""Columns of time, and the figure of the subscriber's own share that they are compared with."""

_GRACE_NS: Final = 300_000_000
"""Around the match and the end of the subscriber's log a sample may be captured and not be logged."""

_GIVES_UP_NS: Final = 600_000_000
"""After a sample was lost for good, the next ones may wait this long for the message that says so."""

_TAKEN_NS: Final = 1_000_000
"""Within this a subscriber's program takes all samples that wait for it."""

_OVERHEAD_BYTES: Final = 200
_DECLARED_BYTES: Final = 20_000
"""What a middleware over TCP adds to each sample at most, and to all of them."""


@dataclass(frozen=True, eq=False)
class Captured:
    """A topic in both captures.

    Attributes:
        near: In the publisher's capture; None without a whole one.
        far: In the subscriber's capture, likewise.
        complete: Whether all packets of its data that left are in the subscriber's capture.
    """

    near: SampleFlow | None
    far: SampleFlow | None
    complete: bool


def is_complete(near: SampleFlow, far: SampleFlow) -> bool:
    """Return whether the subscriber's capture has every UDP packet of the topic that left the publisher."""
    left, came = (flow.packets.where(flow.packets.protocol == UDP) for flow in (near, far))
    return len(left) > 0 and bool(match(left, came).arrived.all())


def of_captures(plan: TopicPlan, sent: TopicLog, came: TopicLog, captured: Captured) -> Iterator[str]:
    """Yield what cannot be true of the logs and the captures together, a sentence each.

    Args:
        plan: What was asked for.
        sent: What the publisher wrote down, whole.
        came: What the subscriber wrote down, whole.
        captured: The topic in both captures.
    """
    if any(flow is not None and (flow.packets.time_ns == NO_TIME).any() for flow in (captured.near, captured.far)):
        return
    if captured.near is not None:
        yield from _of_content(captured.near.heads, sent.samples, sent.samples.sequence, "publisher")
        yield from _of_sending(captured.near.heads)
    if captured.far is not None:
        yield from _of_content(captured.far.heads, came.samples, None, "subscriber")
        yield from _of_arrivals(plan, came, captured.far, complete=captured.complete)


def _of_arrivals(plan: TopicPlan, came: TopicLog, far: SampleFlow, *, complete: bool) -> Iterator[str]:
    """Yield what cannot be true of the subscriber's log and its capture together."""
    arrived = first_arrivals(came)
    yield from _Arrivals.of(arrived, far, complete=complete, reliable=plan.reliable).contradictions()
    yield from _of_copies(came.samples, far)
    yield from _of_room(plan, arrived, far)
    if missing := _missing(plan, came, far, complete=complete):
        what = f"{format_count(missing, 'sample')} arrived by the subscriber's capture"
        yield f"{what}, and are not in the subscriber's log"


def withheld(
    values: Mapping[str, Value], arrived: Stamped, captured: Captured, *, reliable: bool, deadline_s: float | None
) -> dict[str, str]:
    """Return which columns of time the subscriber's program has too large a share in, with the reason.

    Args:
        values: Columns of the topic by the logs.
        arrived: Samples that arrived, each once.
        captured: The topic in both captures.
        reliable: As in `TopicPlan`.
        deadline_s: Deadline of the topic; None without one.
    """
    if captured.far is None or not len(arrived):
        return {}
    held_s = _Arrivals.of(arrived, captured.far, complete=captured.complete, reliable=reliable).held_s
    if held_s is None or not len(held_s):
        return {}
    own_s = {
        "median": float(np.median(held_s)),
        "mean": float(held_s.mean()),
        "95th percentile": float(np.percentile(held_s, 95)),
        "largest": float(held_s.max()),
        "median of those sent": _of_sent(held_s, values, 0.5),
        "95th percentile of those sent": _of_sent(held_s, values, 0.95),
    }
    reasons = {}
    for name, figure in MADE.items():
        value = deadline_s if name == "topic_deadline_misses" else values.get(name)
        if name in values and isinstance(value, float) and own_s[figure] > max(SLOW_S, LARGEST_ERROR * value):
            late = f"the subscriber's log is later than its capture by {own_s[figure]:.3f} s"
            reasons[name] = f"{late} ({figure}): its program was held up, or the log is wrong"
    return reasons


def _of_sent(held_s: Floats, values: Mapping[str, Value], share: float) -> float:
    """Return a quantile of samples that arrived, the one that this share of the samples sent is."""
    sent, received = values.get("topic_sent"), values.get("topic_received")
    more = sent / received if isinstance(sent, int) and isinstance(received, int) and received else 1.0
    return float(np.quantile(held_s, min(share * more, 1.0)))


@dataclass(frozen=True, eq=False)
class _Arrivals:
    """Samples in the subscriber's log beside their packets, those that the capture shows.

    Attributes:
        after_ns: Time of the record less that of the first packet with the sample's head.
        held_s: Time of the record less that of the packet that completed the sample and all before it, of samples of
            which that packet is known; None if the capture does not show it.
    """

    after_ns: Ints
    held_s: Floats | None

    @classmethod
    def of(cls, samples: Stamped, far: SampleFlow, *, complete: bool, reliable: bool) -> "_Arrivals":
        """Return the arrivals of samples of which each is there once; arguments as in `Captured` and `TopicPlan`."""
        heads = far.heads.first()
        _, logged, shown = np.intersect1d(samples.sequence, heads.sequence, return_indices=True)
        at_ns, head_ns = samples.at_ns[logged], heads.at_ns[shown]
        done_ns = _done_ns(far, heads, complete=complete, reliable=reliable) if len(heads) else None
        if done_ns is None:
            return cls(at_ns - head_ns, None)
        held_s = (at_ns - done_ns[shown]) / 1e9
        return cls(at_ns - head_ns, held_s[~_waits(samples, heads)] if reliable and not far.is_tcp else held_s)

    def contradictions(self) -> Iterator[str]:
        """Yield why the times in the log are not those of the capture."""
        early_ns = -int(self.after_ns.min(initial=0))
        if early_ns > STAMP_NS:
            many = int((self.after_ns < -STAMP_NS).sum())
            what = f"{format_count(many, 'sample')} in the subscriber's log came up to {early_ns / 1e9:.6f} s before"
            yield f"{what} their packets in its capture"
        if self.held_s is not None and len(self.held_s) > 2:
            least_s = float(self.held_s.min())
            if least_s > (HANDOVER_NS if len(self.held_s) >= MANY else FEW_HANDOVER_NS) / 1e9:
                yield f"the subscriber's log is {least_s:.6f} s or more later than its capture for every sample"


def _done_ns(far: SampleFlow, heads: SampleHeads, *, complete: bool, reliable: bool) -> Ints | None:
    """Return when each sample, in the order of numbers, and all before it had arrived; None if nothing shows it."""
    if far.is_tcp:
        return _covered_ns(far, heads.end)
    if heads.whole.all():
        in_turn: Ints = np.maximum.accumulate(heads.at_ns) if reliable else heads.at_ns
        return in_turn
    return _before_next_ns(far, heads) if complete else None


def _waits(samples: Stamped, heads: SampleHeads) -> Mask:
    """Return which samples that a capture shows, in the order of numbers, may have waited for one that it does not.

    A reliable middleware holds samples back until the one before them has come, or is given up.
    """
    numbers, first = np.unique(samples.sequence, return_index=True)
    at_ns = samples.at_ns[first]
    rank = np.minimum(np.searchsorted(heads.sequence, numbers), len(heads) - 1)
    shown = heads.sequence[rank] == numbers
    known = np.concatenate((numbers, heads.sequence))
    behind_gap = (numbers > 0) & ~np.isin(numbers - 1, known)
    released_ns = np.where(shown, 0, at_ns)
    released_ns[behind_gap & shown] = np.minimum(at_ns, heads.at_ns[rank] + _GIVES_UP_NS)[behind_gap & shown]
    released_ns = np.maximum.accumulate(released_ns)
    waits: Mask = (behind_gap | (np.append(0, released_ns[:-1]) > heads.at_ns[rank]))[shown]
    return waits


def _covered_ns(far: SampleFlow, end: Ints) -> Ints | None:
    """Return when a TCP connection had brought every byte before some, by the first copy of each segment."""
    if (connection := far.connection()) is None:
        return None
    data, _ = connection
    base = int(end[0])
    starts, first = np.unique(_ahead(data.tcp_seq, base), return_index=True)
    until_ns = np.maximum.accumulate(data.time_ns[first])
    covered: Ints = until_ns[np.maximum(np.searchsorted(starts, _ahead(end, base), side="left") - 1, 0)]
    return covered


def _ahead(number: Ints, base: int) -> Ints:
    """Return how far numbers of TCP are ahead of one: half of them are, half are behind (RFC 9293, section 3.4)."""
    return (number - base + (1 << 31)) % (1 << 32) - (1 << 31)


def _before_next_ns(far: SampleFlow, heads: SampleHeads) -> Ints:
    """Return when the last packet came before the next sample began, of samples in several packets."""
    times_ns, begins_ns = np.sort(far.packets.time_ns), np.sort(heads.at_ns)
    following = np.searchsorted(begins_ns, heads.at_ns, side="right")
    next_ns = np.append(begins_ns, times_ns[-1] + 1)[following]
    last: Ints = times_ns[np.maximum(np.searchsorted(times_ns, next_ns, side="left") - 1, 0)]
    return last


def _of_content(heads: SampleHeads, samples: Stamped, numbers: Ints | None, name: str) -> Iterator[str]:
    """Yield where a capture shows samples under another time than a log, or samples that a publisher's log lacks."""
    if numbers is not None and (unknown := int((~np.isin(heads.sequence, numbers)).sum())):
        yield f"{format_count(unknown, 'sample')} in the {name}'s capture are not in its log"
    first = heads.first()
    _, logged, shown = np.intersect1d(samples.sequence, first.sequence, return_indices=True)
    if other := int((samples.sent_ns[logged] != first.sent_ns[shown]).sum()):
        yield f"{format_count(other, 'sample')} in the {name}'s log have another time of sending than in its capture"


def _of_sending(near: SampleHeads) -> Iterator[str]:
    """Yield why the times of sending are not those of the publisher's capture."""
    first = near.first()
    after_ns = first.at_ns - first.sent_ns
    if len(after_ns) and int(after_ns.min()) < -STAMP_NS:
        early_s = -int(after_ns.min()) / 1e9
        yield f"a sample left {early_s:.6f} s before it was made, by the publisher's capture and log"
    if len(after_ns) > 2 and after_ns.min() > (HANDOVER_NS if len(after_ns) >= MANY else FEW_HANDOVER_NS):
        late_s = int(after_ns.min()) / 1e9
        yield f"every sample left {late_s:.6f} s or more after it was made, by the publisher's capture and log"


def _of_copies(samples: Stamped, far: SampleFlow) -> Iterator[str]:
    """Yield how many samples a log has more often than the capture shows them."""
    numbers, copies = np.unique(samples.sequence, return_counts=True)
    shown_numbers, shown_copies = np.unique(far.heads.sequence, return_counts=True)
    known = np.isin(numbers, shown_numbers)
    most = np.ones(len(numbers), dtype=np.int64)
    if not far.is_tcp:  # which hands every byte over once, however often it came
        most[known] = shown_copies[np.searchsorted(shown_numbers, numbers[known])]
    if more := int(((copies > most) & (known | far.is_tcp)).sum()):
        yield f"the subscriber's log has {format_count(more, 'sample')} more often than they arrived"


def _of_room(plan: TopicPlan, arrived: Stamped, far: SampleFlow) -> Iterator[str]:
    """Yield how many samples of a log, each there once, the capture has no room for."""
    if not plan.on_ports and not len(far.heads):
        return
    packets = far.packets
    size_bytes = plan.size_bytes + plan.envelope_bytes
    lacking = int((~np.isin(arrived.sequence, far.heads.sequence)).sum())
    carried = packets.tcp_payload_bytes + np.maximum(packets.udp_bytes - UDP_HEADER_BYTES, 0)
    if far.is_tcp or size_bytes > _DATAGRAM_BYTES:
        room = int(carried.sum()) // size_bytes - len(far.heads.first())
    else:
        room = int((carried // size_bytes).sum()) - len(far.heads)
    if lacking > max(room, 0):
        what = f"{format_count(lacking - max(room, 0), 'sample')} in the subscriber's log"
        yield f"{what} are not in its capture"
    if not len(far.heads):
        yield from _of_bytes(arrived, packets.time_ns, carried, size_bytes)


_DATAGRAM_BYTES: Final = 1_200
"""A DDS sample that is larger may be cut into several messages, each smaller than the sample."""


def _of_bytes(samples: Stamped, times_ns: Ints, carried: Ints, size_bytes: int) -> Iterator[str]:
    """Yield that samples are logged before so many bytes had arrived, if the capture shows none of their heads."""
    order, arrival = np.argsort(times_ns, kind="stable"), np.sort(samples.at_ns)
    bytes_until = np.concatenate(([0], np.cumsum(carried[order])))
    had = bytes_until[np.searchsorted(times_ns[order], arrival + STAMP_NS, side="right")]
    needed = size_bytes * np.arange(1, len(arrival) + 1)
    if early := int((had < needed).sum()):
        yield f"{format_count(early, 'sample')} in the subscriber's log came before its capture has their bytes"


def _missing(plan: TopicPlan, came: TopicLog, far: SampleFlow, *, complete: bool) -> int:
    """Return how many samples the subscriber's robot received whole that its log lacks without a known reason.

    Known reasons: the subscriber did not know the publisher yet; its queue overflowed, because its program did not
    take as many samples as the queue holds; one before was still missing, or a later one had come already.
    """
    if not len(far.heads):
        return _missing_bytes(plan, came, far)
    heads = far.heads.first()
    begins_ns = int(came.times_ns[-1] if came.matched_ns is None else came.matched_ns)
    settled = (heads.at_ns > begins_ns + _GRACE_NS) & (heads.at_ns < came.times_ns[-1] - _GRACE_NS)
    received = _is_received(plan, heads, came.samples, far, complete=complete)
    lacks = settled & received & ~np.isin(heads.sequence, came.samples.sequence)
    if not lacks.any():
        return 0
    return int((~_overflowed(plan, came.samples, heads, lacks, int(came.times_ns[-1]))).sum())


def _is_received(plan: TopicPlan, heads: SampleHeads, samples: Stamped, far: SampleFlow, *, complete: bool) -> Mask:
    """Return which samples, in the order of their numbers, the subscriber's middleware must have handed over."""
    if far.is_tcp:
        return _is_acknowledged(heads, far)
    whole = heads.whole | complete
    if plan.reliable:
        # Nothing is handed over behind a gap; what comes before the next one is handed over, is handed over first.
        gapless = np.logical_and.accumulate(heads.sequence == np.arange(len(heads)))
        numbers, first = np.unique(samples.sequence, return_index=True)
        following = np.searchsorted(numbers, heads.sequence, side="right")
        next_ns = np.append(samples.at_ns[first], -1)[following]
        return whole & (gapless | (next_ns >= heads.at_ns))
    received: Mask = whole & (heads.at_ns >= np.maximum.accumulate(heads.at_ns))
    return received


def _is_acknowledged(heads: SampleHeads, far: SampleFlow) -> Mask:
    """Return which samples in TCP the subscriber's kernel acknowledged to the last byte."""
    connection = far.connection()
    if connection is None or not len(connection[1]):
        return np.zeros(len(heads), dtype=np.bool_)
    base = int(heads.end[0])
    acknowledged: Mask = _ahead(heads.end, base) <= _ahead(connection[1].tcp_ack, base).max()
    return acknowledged


def _overflowed(plan: TopicPlan, samples: Stamped, heads: SampleHeads, lacks: Mask, end_ns: int) -> Mask:
    """Return for each sample that a log lacks whether a queue of the subscriber may have dropped it."""
    if plan.depth is None:
        return np.zeros(int(lacks.sum()), dtype=np.bool_)
    arrived_ns, taken_ns = np.sort(heads.at_ns), np.append(np.sort(samples.at_ns), end_ns)
    lost_ns = heads.at_ns[lacks]
    next_ns = taken_ns[np.minimum(np.searchsorted(taken_ns, lost_ns), len(taken_ns) - 1)]
    queued = np.searchsorted(arrived_ns, next_ns, side="right") - np.searchsorted(arrived_ns, lost_ns, side="right")
    # One that was missing releases all that waited for it at once, of some of which the capture may show no head.
    taken = np.searchsorted(taken_ns[:-1], next_ns + _TAKEN_NS, side="right") - np.searchsorted(
        taken_ns[:-1], next_ns
    )
    queued = np.maximum(queued, taken)
    newest_ns = arrived_ns[max(len(arrived_ns) - plan.depth, 0)]
    overflowed: Mask = (queued >= plan.depth) & ((lost_ns < newest_ns) | (taken >= plan.depth))
    return overflowed


def _missing_bytes(plan: TopicPlan, came: TopicLog, far: SampleFlow) -> int:
    """Return how many samples fewer a log has than bytes of TCP arrived, if the capture shows none of their heads."""
    if not far.is_tcp:
        return 0
    most_bytes = plan.size_bytes + plan.envelope_bytes + _OVERHEAD_BYTES
    payload = far.packets.where(far.packets.tcp_payload_bytes > 0)
    _, first = np.unique(payload.tcp_seq, return_index=True)
    arrived_bytes = int(payload.tcp_payload_bytes[first].sum()) - _DECLARED_BYTES
    return max(arrived_bytes // most_bytes - len(came.samples), 0)
