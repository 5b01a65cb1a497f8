"""Contradictions between the logs of a topic and the procedure, the time of the attempt, and each other.

`topic_captures` compares the same logs with the captures.
"""

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.model import Role
from fieldkit.core.units import format_count
from fieldkit.ros.streams import topic_samples
from fieldkit.ros.streams.topic_samples import TopicLog

MAX_SLEW_NS: Final = 1_000_000
"""Maximum time by which a slewed clock may make a program's later time stamp smaller than the previous one."""

SETTLING_NS: Final = 500_000_000
"""Minimum time between the record that the subscription was discovered (`MATCHED`) and the first sample
(`fieldkit.agent.messaging.stream.SETTLING_S`)."""

PADDING_BYTES: Final = 3
"""DDS pads a sample to a multiple of 4 bytes, and some implementations do not report this."""

_END_NAMES: Final = {topic_samples.PUBLISHER: "publisher", topic_samples.SUBSCRIBER: "subscriber"}


@dataclass(frozen=True)
class TopicPlan:
    """Settings of a topic in a procedure.

    Attributes:
        topic: Its name.
        samples: Number of samples that the publisher offers, including skipped ones.
        size_bytes: Data bytes of a sample.
        envelope_bytes: Bytes that serialization adds to the data.
        reliable: True if samples are retransmitted until they arrive.
        depth: Number of samples that a subscriber queues until its program reads them; None for all.
        in_order: True if one thread of the subscriber's program reads all samples.
        uses_expected_ports: True if all packets of the topic use the ports that the procedure expects.
    """

    topic: str
    samples: int
    size_bytes: int
    envelope_bytes: int
    reliable: bool
    depth: int | None
    in_order: bool
    uses_expected_ports: bool


def check_logs(plan: TopicPlan, publisher_log: TopicLog, subscriber_log: TopicLog) -> Iterator[str]:
    """Yield each contradiction in the two logs of one stream as a sentence.

    Args:
        plan: Settings of the procedure.
        publisher_log: Complete log of the publisher.
        subscriber_log: Complete log of the subscriber.
    """
    yield from _log_contradictions(plan, publisher_log, topic_samples.PUBLISHER)
    yield from _log_contradictions(plan, subscriber_log, topic_samples.SUBSCRIBER)
    yield from _publisher_problems(plan, publisher_log)
    yield from _wrong_sizes(plan, subscriber_log, PADDING_BYTES, "subscriber")
    if plan.in_order and (backward_s := _backward_s(subscriber_log)):
        yield f"a sample in the subscriber's log is {backward_s:.3f} s earlier than the previous one"
    samples, arrivals = publisher_log.samples, subscriber_log.samples
    if unsent_count := int((~np.isin(arrivals.sequence, publisher_log.numbers)).sum()):
        yield f"{format_count(unsent_count, 'sample')} arrived with numbers that the publisher's log does not have"
    _, sent_index, received_index = np.intersect1d(samples.sequence, arrivals.sequence, return_indices=True)
    if (samples.sent_ns[sent_index] != arrivals.sent_ns[received_index]).any():
        yield "samples arrived that the publisher did not send: another stream has the same topic and domain"
    if len(sent_index) > 1 and (samples.at_ns[sent_index] == arrivals.at_ns[received_index]).all():
        yield "the subscriber's log is a copy of the publisher's"


def check_times(logs: Mapping[Role, TopicLog], windows: Mapping[Role, tuple[int, int] | None]) -> Iterator[str]:
    """Yield a sentence for each log with records from before or after the attempt, by the clock of the robot.

    Args:
        logs: Logs by role.
        windows: The robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if unknown.
    """
    for role, log in logs.items():
        window = windows.get(role)
        if window is None or not len(log.times_ns):
            continue
        early_s = (window[0] - int(log.times_ns.min())) / 1e9
        late_s = (int(log.times_ns.max()) - window[1]) / 1e9
        if early_s > 0:
            yield f"the {role}'s topic log has a record from {early_s:.3f} s before the attempt, by the robot's clock"
        if late_s > 0:
            yield f"the {role}'s topic log has a record from {late_s:.3f} s after the attempt, by the robot's clock"


def _log_contradictions(plan: TopicPlan, log: TopicLog, role: int) -> Iterator[str]:
    """Yield the contradictions of a log with its role, its topic, and its start and end records."""
    name = _END_NAMES[role]
    if log.role is not None and log.role != role:
        yield f"the {name}'s log was written by the {_END_NAMES.get(log.role, 'unknown end')} of the topic"
    if log.topic_sum is not None and log.topic_sum != zlib.crc32(plan.topic.encode()):
        yield f"the {name}'s log is of another topic than {plan.topic}"
    has_valid_counts = (
        log.kinds.get(topic_samples.DISCOVERY_STARTED) == 1 and log.kinds.get(topic_samples.MATCHED, 0) <= 1
    )
    unexpected_kinds = (
        (topic_samples.FOREIGN, topic_samples.READ, topic_samples.UNREADABLE)
        if role == topic_samples.PUBLISHER
        else (topic_samples.REFUSED, topic_samples.SKIPPED)
    )
    if not has_valid_counts or any(log.kinds.get(kind) for kind in unexpected_kinds):
        yield f"the {name}'s log has records that no {name} writes"
    times_ns = log.times_ns
    if len(times_ns) and (times_ns.min() < times_ns[0] - MAX_SLEW_NS or times_ns.max() > times_ns[-1] + MAX_SLEW_NS):
        yield f"the {name}'s log has records from before its start or after its end"
    if len(log.samples) and log.matched_ns is None:
        yield f"the {name}'s log has samples, but the other end was never discovered"


def _publisher_problems(plan: TopicPlan, publisher_log: TopicLog) -> Iterator[str]:
    """Yield the properties of a publisher's log that contradict the plan or cannot occur."""
    samples, numbers = publisher_log.samples, publisher_log.numbers
    if (numbers != np.arange(len(numbers))).any():
        yield "the sample numbers in the publisher's log do not start at 0, or have a gap"
    offered_count = len(numbers) + publisher_log.skipped
    if publisher_log.matched_ns is not None and offered_count != plan.samples:
        yield f"the publisher's log accounts for {offered_count} instead of {format_count(plan.samples, 'sample')}"
    yield from _wrong_sizes(plan, publisher_log, 0, "publisher")
    if len(samples) and (samples.at_ns < samples.sent_ns - MAX_SLEW_NS).any():
        yield "the publisher's log has a sample that the middleware accepted before it was created"
    if (np.diff(publisher_log.times_ns) < -MAX_SLEW_NS).any() or (np.diff(samples.sent_ns) < -MAX_SLEW_NS).any():
        yield "the records of the publisher's log are not in chronological order"
    if len(samples) and publisher_log.matched_ns is not None:
        early_ns = publisher_log.matched_ns + SETTLING_NS - int(samples.sent_ns[0])
        if early_ns > MAX_SLEW_NS:
            yield f"the publisher's log has its first sample {early_ns / 1e9:.3f} s too early after the subscription"


def _wrong_sizes(plan: TopicPlan, log: TopicLog, padding_bytes: int, name: str) -> Iterator[str]:
    size_bytes = plan.size_bytes + plan.envelope_bytes
    sizes = log.samples.size_bytes
    if count := int(((sizes < size_bytes) | (sizes > size_bytes + padding_bytes)).sum()):
        samples = f"{format_count(count, 'sample')} with a size other than {size_bytes} bytes"
        yield f"the {name}'s log has {samples}"


def _backward_s(log: TopicLog) -> float:
    """Return the largest time by which a sample is earlier than the previous one; 0 if the order is correct."""
    backward_ns = -int(np.diff(log.samples.at_ns).min(initial=0))
    return backward_ns / 1e9 if backward_ns > MAX_SLEW_NS else 0.0


_SAME_FILE: Final = "the same file: checksum and count of samples"

CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="samples sent",
        columns=("topic_sent", "topic_refused", "topic_skipped", "topic_loss"),
        source="`ROLE-topic.bin` of the publisher: samples",
        against=("the rate and duration of the procedure", "the publisher's capture: sample headers", _SAME_FILE),
        tolerance=(
            "none; every number from 0 on is sent, refused or skipped, and a sample in the capture is in the log"
        ),
    ),
    CrossCheck(
        quantity="samples received",
        columns=("topic_received", "topic_loss", "topic_repeated"),
        source="`ROLE-topic.bin` of the subscriber: samples",
        against=(
            "the publisher's log: numbers, sizes and times of sending",
            "the subscriber's capture: sample headers, packets and bytes of samples",
            _SAME_FILE,
        ),
        tolerance=(
            "a sample that arrived may be missing if the subscriber's queue overflowed, if an earlier one is missing "
            "and "
            "the middleware preserves the order, or within 0.3 s of the discovery or the end"
        ),
    ),
    CrossCheck(
        quantity="time of sending of each sample",
        columns=("topic_delay_*", "topic_age_*", "topic_jitter_s"),
        source="`ROLE-topic.bin` of both ends: time in the sample",
        against=("the publisher's capture: time in the sample, and time of its packet", "the subscriber's capture"),
        tolerance=(
            "the packet of the fastest sample may leave 5 ms after the time in the sample (20 ms if there are fewer "
            "than 20 "
            "samples)"
        ),
    ),
    CrossCheck(
        quantity="time of arrival of each sample",
        columns=("topic_delay_*", "topic_age_*", "topic_jitter_s"),
        source="`ROLE-topic.bin` of the subscriber: time of the log entry",
        against=(
            "the subscriber's capture: time of the packet with the sample",
            "the robot's clock before and after the attempt",
        ),
        tolerance=(
            "a log entry must not be earlier than its packet; the fastest one may be 5 ms later (20 ms if there "
            "are fewer than 20)"
        ),
    ),
    CrossCheck(
        quantity="delay added by the subscriber's program",
        columns=("topic_delay_*", "topic_age_*", "topic_jitter_s", "topic_deadline_misses"),
        source="`ROLE-topic.bin` of the subscriber: time of the log entry",
        against=("the subscriber's capture: time of the packet with the sample",),
        tolerance=(
            "20 ms, or a tenth of the delay, age or jitter in the column, because a busy robot delays single samples"
        ),
        outcome=CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        quantity="discovery",
        columns=("topic_discovered", "topic_discovery_s"),
        source="`ROLE-topic.bin` of the publisher: start and discovery",
        against=("the robot's clock before and after the attempt", "the first sample, 0.5 s after the discovery"),
        tolerance=(
            "the first sample may be 0.1 s late, as on a busy robot; if it is later, the discovery time is empty"
        ),
    ),
    CrossCheck(
        quantity="completeness of a topic's captures",
        columns=("topic_capture_withheld",),
        source="`ROLE-capture.log`: packets dropped before tcpdump",
        against=("`ROLE.pcap`: number of packets, which is in the log too",),
        tolerance=(
            "none; if a packet was dropped, all columns that need the captures are empty, and those of the logs "
            "remain"
        ),
        outcome=CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        quantity="packets and bytes of a topic",
        columns=("topic_data_*", "topic_discovery_packets", "topic_discovery_bytes", "topic_packet_loss"),
        source="the captures: packets of its ports",
        against=(),
        tolerance="only the captures contain discovery; the logs give a lower bound of the number of data packets",
        outcome=CheckOutcome.UNCHECKED,
    ),
)
