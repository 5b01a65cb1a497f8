"""Stalls of a topic: times during which a sample was overdue at its subscriber."""

from dataclasses import replace

import numpy as np

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import delay, deliveries, stalls
from fieldkit.measure.transfers.clock_offset import StampPairs
from fieldkit.measure.transfers.deliveries import FlowSchedule, StreamDeliveries
from fieldkit.ros.streams.topic_columns import TopicTraffic
from fieldkit.ros.streams.topic_samples import TopicLog

# The columns of transfers need captures; those of topics need the logs.
COLUMNS = tuple(
    replace(column, meaning=column.meaning.replace("complete captures", "complete logs"))
    for column in stalls.declare_columns("topic", "the topic", rank=83)
)


def require_steady_clocks(flow: TopicTraffic, sender: Packets | None, receiver: Packets | None) -> None:
    """Raise an error if the captures show that a robot's clock was set.

    Raises:
        EvidenceError: No clock offset fits both captures.
    """
    if sender is None or receiver is None:
        return
    ends = flow.sender_address, flow.receiver_address
    has_packets = (packets.are_from(end).any() for packets in (sender, receiver) for end in ends)
    if all(has_packets) and delay.clocks_between(sender, receiver, *ends) is None:
        raise EvidenceError(delay.UNSTEADY)


def topic_deliveries(
    publisher_log: TopicLog | None, subscriber_log: TopicLog | None, schedule: FlowSchedule
) -> StreamDeliveries:
    """Return the deliveries of a topic.

    Args:
        publisher_log: Log of the publisher; None if it is incomplete.
        subscriber_log: Log of the subscriber; None if it is incomplete.
        schedule: Interval and duration of the stream.

    Raises:
        EvidenceError: The deliveries cannot be determined from the logs.
    """
    if publisher_log is None or subscriber_log is None:
        raise EvidenceError("there are no complete logs of both ends")
    samples = publisher_log.samples
    if not len(samples):
        raise EvidenceError("nothing was sent")
    _, sent_index, received_index = np.intersect1d(
        samples.sequence, subscriber_log.samples.sequence, return_indices=True
    )
    at_ns = subscriber_log.samples.at_ns[np.sort(received_index)]
    if (np.diff(at_ns) < -deliveries.REORDERING_NS).any():
        raise EvidenceError("a sample is earlier than the one before it: a clock was set back")
    pairs = StampPairs(samples.sent_ns[sent_index], subscriber_log.samples.at_ns[received_index])
    first_ns, last_ns = int(samples.sent_ns.min()), int(samples.sent_ns.max())
    sent_ns = first_ns, first_ns, last_ns  # the first packet already has payload
    return deliveries.stream_deliveries(np.sort(at_ns), sent_ns, pairs, schedule)


def measure(
    flow: TopicTraffic,
    logs: tuple[TopicLog | None, TopicLog | None],
    captures: tuple[Packets | None, Packets | None],
    schedule: FlowSchedule,
) -> Measured:
    """Return the columns of the stalls of a topic.

    Args:
        flow: Addresses and ports that identify the packets of the topic.
        logs: Logs of publisher and subscriber; see `topic_deliveries`.
        captures: Packets that their robots captured; None without a complete capture.
        schedule: Interval and duration of the stream.
    """
    return stalls.measure("topic", lambda: read_deliveries(flow, logs, captures, schedule))


def read_deliveries(
    flow: TopicTraffic,
    logs: tuple[TopicLog | None, TopicLog | None],
    captures: tuple[Packets | None, Packets | None],
    schedule: FlowSchedule,
) -> list[StreamDeliveries]:
    """Return the deliveries of a topic.

    The arguments are those of `measure`; the errors are those of `topic_deliveries` and `require_steady_clocks`.
    """
    require_steady_clocks(flow, *captures)
    return [topic_deliveries(*logs, schedule)]
