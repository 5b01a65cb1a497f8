"""Contradictions in the logs of a topic: with the procedure, with the time of the attempt, and between the two ends.

`topic_captures` compares the same logs with the captures.
"""

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.model import Role
from fieldkit.core.units import format_count
from fieldkit.measure.transfers import topic_log
from fieldkit.measure.transfers.topic_log import TopicLog

SLEW_NS: Final = 1_000_000
"""Difference of two times that one program took one after the other and that a slewed clock may show reversed."""

SETTLES_NS: Final = 500_000_000
"""Least time between the record of the match and the first sample (`fieldkit.agent.stream.SETTLES_S`)."""

PADDING_BYTES: Final = 3
"""DDS fills a sample to words of 4 bytes, and some implementations do not say so."""

_NAMES: Final = {topic_log.PUBLISHER: "publisher", topic_log.SUBSCRIBER: "subscriber"}


@dataclass(frozen=True)
class TopicPlan:
    """What a procedure asks of a topic.

    Attributes:
        topic: Its name.
        samples: Samples that the publisher offers, skipped ones included.
        size_bytes: Data of a sample.
        envelope_bytes: What serialization adds to the data.
        reliable: Whether samples are sent again until they arrive.
        depth: Samples that a subscriber keeps until its program takes them; None for all.
        in_order: Whether one thread of the subscriber's program takes all samples.
        on_ports: Whether all packets of the topic have the ports that the procedure expects.
    """

    topic: str
    samples: int
    size_bytes: int
    envelope_bytes: int
    reliable: bool
    depth: int | None
    in_order: bool
    on_ports: bool


def of_logs(plan: TopicPlan, sent: TopicLog, came: TopicLog) -> Iterator[str]:
    """Yield what cannot be true of the two logs of one stream, a sentence each.

    Args:
        plan: What was asked for.
        sent: What the publisher wrote down, whole.
        came: What the subscriber wrote down, whole.
    """
    yield from _of_the_end(plan, sent, topic_log.PUBLISHER)
    yield from _of_the_end(plan, came, topic_log.SUBSCRIBER)
    yield from _of_publisher(plan, sent)
    yield from _of_sizes(plan, came, PADDING_BYTES, "subscriber")
    if plan.in_order and (back_s := _back_s(came)):
        yield f"a sample in the subscriber's log is {back_s:.3f} s earlier than the one before it"
    samples, arrived = sent.samples, came.samples
    if unsent := int((~np.isin(arrived.sequence, sent.numbers)).sum()):
        yield f"{format_count(unsent, 'sample')} arrived with numbers that the publisher's log does not have"
    _, left, index = np.intersect1d(samples.sequence, arrived.sequence, return_indices=True)
    if (samples.sent_ns[left] != arrived.sent_ns[index]).any():
        yield "samples arrived that the publisher did not send: another stream has the same topic and domain"
    if len(left) > 1 and (samples.at_ns[left] == arrived.at_ns[index]).all():
        yield "the subscriber's log is a copy of the publisher's"


def of_window(logs: Mapping[Role, TopicLog], windows: Mapping[Role, tuple[int, int] | None]) -> Iterator[str]:
    """Yield which log has records from before the attempt or after it, by the clock of its robot.

    Args:
        logs: By role.
        windows: The robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if it is not known.
    """
    for role, log in logs.items():
        window = windows.get(role)
        if window is None or not len(log.times_ns):
            continue
        early_s = (window[0] - int(log.times_ns.min())) / 1e9
        late_s = (int(log.times_ns.max()) - window[1]) / 1e9
        if early_s > 0:
            yield f"the {role}'s topic log has a record of {early_s:.3f} s before the attempt, by the robot's clock"
        if late_s > 0:
            yield f"the {role}'s topic log has a record of {late_s:.3f} s after the attempt, by the robot's clock"


def _of_the_end(plan: TopicPlan, log: TopicLog, end: int) -> Iterator[str]:
    """Yield why a log is of another end of a topic, or of another topic."""
    name = _NAMES[end]
    if log.end is not None and log.end != end:
        yield f"the {name}'s log was written by the {_NAMES.get(log.end, 'unknown end')} of the topic"
    if log.topic_sum is not None and log.topic_sum != zlib.crc32(plan.topic.encode()):
        yield f"the {name}'s log is of another topic than {plan.topic}"
    once = (log.kinds.get(topic_log.BEGUN) == 1, log.kinds.get(topic_log.MATCHED, 0) <= 1)
    foreign = (topic_log.FOREIGN,) if end == topic_log.PUBLISHER else (topic_log.REFUSED, topic_log.SKIPPED)
    if not all(once) or any(log.kinds.get(kind) for kind in foreign):
        yield f"the {name}'s log has records that no {name} writes"
    times_ns = log.times_ns
    if len(times_ns) and (times_ns.min() < times_ns[0] - SLEW_NS or times_ns.max() > times_ns[-1] + SLEW_NS):
        yield f"the {name}'s log has records from before its beginning or after its end"
    if len(log.samples) and log.matched_ns is None:
        yield f"the {name}'s log has samples, and the other end was never known"


def _of_publisher(plan: TopicPlan, sent: TopicLog) -> Iterator[str]:
    """Yield what no publisher writes."""
    samples, numbers = sent.samples, sent.numbers
    if (numbers != np.arange(len(numbers))).any():
        yield "the publisher's log does not number its samples from 0 on without a gap"
    offered = len(numbers) + sent.skipped
    if sent.matched_ns is not None and offered != plan.samples:
        yield f"the publisher's log accounts for {offered} of {format_count(plan.samples, 'sample')}"
    yield from _of_sizes(plan, sent, 0, "publisher")
    if len(samples) and (samples.at_ns < samples.sent_ns - SLEW_NS).any():
        yield "the publisher's log has a sample that the middleware took before it was made"
    if (np.diff(sent.times_ns) < -SLEW_NS).any() or (np.diff(samples.sent_ns) < -SLEW_NS).any():
        yield "the records of the publisher's log are not in the order of time"
    if len(samples) and sent.matched_ns is not None:
        early_ns = sent.matched_ns + SETTLES_NS - int(samples.sent_ns[0])
        if early_ns > SLEW_NS:
            yield f"the publisher's log has its first sample {early_ns / 1e9:.3f} s too soon after the subscription"


def _of_sizes(plan: TopicPlan, log: TopicLog, padding_bytes: int, name: str) -> Iterator[str]:
    size_bytes = plan.size_bytes + plan.envelope_bytes
    sizes = log.samples.size_bytes
    if wrong := int(((sizes < size_bytes) | (sizes > size_bytes + padding_bytes)).sum()):
        what = f"{format_count(wrong, 'sample')} of another size than {size_bytes} bytes"
        yield f"the {name}'s log has {what}"


def _back_s(log: TopicLog) -> float:
    """Return by how much a sample is earlier than the one before it at most; 0 if none is."""
    back_ns = -int(np.diff(log.samples.at_ns).min(initial=0))
    return back_ns / 1e9 if back_ns > SLEW_NS else 0.0
