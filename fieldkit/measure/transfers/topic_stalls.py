"""Deliveries of a topic, by the logs of its ends: a sample is delivered when the subscriber has it the first time.

In a capture heartbeats, acknowledgements and samples share their ports, so packets do not show what was delivered.
"""

from dataclasses import replace

import numpy as np

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import delay, deliveries, stalls
from fieldkit.measure.transfers.clocks import StampPairs
from fieldkit.measure.transfers.deliveries import Delivery, FlowSchedule
from fieldkit.measure.transfers.topic_log import TopicLog
from fieldkit.measure.transfers.topics import TopicTraffic

COLUMNS = tuple(
    replace(column, meaning=column.meaning.replace("whole captures", "whole logs"))
    for column in stalls.declared("topic", "the topic", 83)
)


def demand_steady(flow: TopicTraffic, sender: Packets | None, receiver: Packets | None) -> None:
    """Refuse times of two robots of which one set its clock meanwhile, as far as captures show it.

    Raises:
        EvidenceError: No clock fits both captures.
    """
    if sender is None or receiver is None:
        return
    ends = flow.sender_address, flow.receiver_address
    both = (packets.are_from(end).any() for packets in (sender, receiver) for end in ends)
    if all(both) and delay.between(sender, receiver, *ends) is None:
        raise EvidenceError(delay.UNSTEADY)


def delivery(sent: TopicLog | None, came: TopicLog | None, expected: FlowSchedule) -> Delivery:
    """Return the deliveries of a topic.

    Args:
        sent: Log of the publisher; None if that is not whole.
        came: Log of the subscriber, likewise.
        expected: What is known of the stream.

    Raises:
        EvidenceError: The logs do not show them.
    """
    if sent is None or came is None:
        raise EvidenceError("there are no whole logs of both ends")
    left = sent.samples
    if not len(left):
        raise EvidenceError("nothing was sent")
    _, mine, first = np.intersect1d(left.sequence, came.samples.sequence, return_indices=True)
    at_ns = came.samples.at_ns[np.sort(first)]
    if (np.diff(at_ns) < -deliveries.BACK_NS).any():
        raise EvidenceError("a sample is earlier than the one before it: a clock was set back")
    pairs = StampPairs(left.sent_ns[mine], came.samples.at_ns[first])
    first_ns, last_ns = int(left.sent_ns.min()), int(left.sent_ns.max())
    return deliveries.of_stream(np.sort(at_ns), (first_ns, first_ns, last_ns), pairs, expected)


def measure(
    flow: TopicTraffic,
    logs: tuple[TopicLog | None, TopicLog | None],
    captured: tuple[Packets | None, Packets | None],
    expected: FlowSchedule,
) -> Measured:
    """Return the columns of the stalls of a topic.

    Args:
        flow: What identifies its packets.
        logs: As for `delivery`, of publisher and subscriber.
        captured: What their robots captured meanwhile; None if there is no whole capture.
        expected: What is known of the stream.
    """
    return stalls.measure("topic", lambda: read(flow, logs, captured, expected))


def read(
    flow: TopicTraffic,
    logs: tuple[TopicLog | None, TopicLog | None],
    captured: tuple[Packets | None, Packets | None],
    expected: FlowSchedule,
) -> list[Delivery]:
    """Return the deliveries of a topic; arguments as of `measure`, errors as of `delivery` and `demand_steady`."""
    demand_steady(flow, *captured)
    return [delivery(*logs, expected)]
