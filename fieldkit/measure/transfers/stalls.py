"""Stalls of a flow: times during which new payload was overdue at its receiver.

Payload is overdue from the previous delivery on; in a flow with a fixed rate, from one sending interval later. Time
in which the sender had nothing to send is therefore not part of a stall. Overdue time longer than
`Delivery.min_stall_s` is a stall. Time before the first payload, during which a connection is established, and after
the last one, while more was due, is included only if it is that long. A stall after the last payload is
right-censored: it had not ended when the flow ended.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from fieldkit.core.columns import Column, Figure, Kind, Measured, columns
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure import robot_clock
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence import reading
from fieldkit.measure.transfers import delay, deliveries, tcp, udp
from fieldkit.measure.transfers.clock_offset import StampPairs
from fieldkit.measure.transfers.deliveries import Delivery, FlowSchedule
from fieldkit.measure.transfers.tcp import TcpFrames
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.measure.transfers.udp import UdpPackets

if TYPE_CHECKING:  # a trial without topics does not import them
    from fieldkit.measure.transfers.topic_columns import TopicTraffic
    from fieldkit.measure.transfers.topic_samples import TopicLog

RANK: Final = 120
"""Position of the columns in trial.csv: after those of earlier versions."""


@dataclass(frozen=True)
class Stalls:
    """Stalls of one stream or of several.

    Attributes:
        longest_s: Longest time during which payload was overdue, even if it is too short for a stall.
        count: Number of stalls.
        is_open: True if a stall had not ended, so that `longest_s` is a lower bound.
    """

    longest_s: float
    count: int
    is_open: bool


def declare_columns(flow: str, label: str, rank: int) -> tuple[Column, ...]:
    """Return the columns for a kind of flow.

    Args:
        flow: Prefix of the columns' names: `transfer`.
        label: Name of the flow in their labels: `the transfer`.
        rank: Rank of their figures.
    """
    bound = f"{flow}_stall_at_least_s"
    return columns(
        RANK,
        (
            f"{flow}_stall_s",
            "s",
            (
                "Longest time of any stream during which new payload was overdue at the receiver. "
                "Empty if a stall had not ended, and without complete captures of both ends."
            ),
            Figure(f"longest stall of {label}", Kind.MEDIAN, rank=rank, at_least=bound),
        ),
        (
            f"{flow}_stalls",
            "count",
            (
                "Number of times that new payload was overdue for more than 0.2 s, 2 round trips of TCP's handshake "
                "and 3 sending intervals, in all streams together."
            ),
            Figure(f"stalls of {label}", Kind.MEAN, rank=rank),
        ),
        (bound, "s", f"Lower bound of {flow}_stall_s if a stall had not ended, else empty."),
    )


def cross_checks(flow: str) -> tuple[CrossCheck, ...]:
    """Return the sources of the columns for a kind of flow, and the checks between them."""
    return (
        CrossCheck(
            quantity="time without new payload at the receiver",
            columns=(f"{flow}_stall_s", f"{flow}_stalls", f"{flow}_stall_at_least_s"),
            source="receiver's capture: times of the frames that deliver new payload",
            against=(
                "sender's capture: the same packets, and the clock offset that fits both captures",
                "`ROLE-before.txt` and `ROLE-after.txt`: whether a clock was set",
            ),
            tolerance="packets may be out of order by 0.1 s, because two processors capture them",
            outcome=CheckOutcome.WITHHELD,
        ),
    )


def find(delivery: Delivery) -> Stalls:
    """Return the stalls of a stream.

    Raises:
        EvidenceError: Only a single packet arrived, so no time can be computed.
    """
    at_ns, min_stall_s = delivery.at_ns, delivery.min_stall_s
    if not len(at_ns):
        return _stall_without_arrivals(delivery)
    overdue_s = np.maximum(np.diff(at_ns) / 1e9 - delivery.interval_s, 0.0)
    before_s = (int(at_ns[0]) - delivery.begin_ns) / 1e9
    after_s = 0.0
    if delivery.end_ns is not None:
        after_s = (delivery.end_ns - int(at_ns[-1])) / 1e9 - delivery.interval_s
    ends_s = [seconds for seconds in (before_s, after_s) if seconds > min_stall_s]
    if not len(overdue_s) and not ends_s:
        raise EvidenceError("only one packet of the flow arrived, so no time can be computed")
    return Stalls(
        longest_s=max(float(overdue_s.max(initial=0.0)), *ends_s, 0.0),
        count=int((overdue_s > min_stall_s).sum()) + len(ends_s),
        is_open=after_s > min_stall_s,
    )


def _stall_without_arrivals(delivery: Delivery) -> Stalls:
    """Return the stall of a stream without any arrival: all of its duration."""
    duration_s = ((delivery.end_ns or delivery.begin_ns) - delivery.begin_ns) / 1e9
    if duration_s <= 0:
        raise EvidenceError("no packet of the flow arrived, and only one was sent")
    return Stalls(duration_s, 1, is_open=True)


def measure(flow: str, deliveries: Callable[[], Sequence[Delivery]]) -> Measured:
    """Return the columns for a flow.

    Args:
        flow: As for `declare_columns`.
        deliveries: Returns the deliveries of each stream; raises `EvidenceError` if they are unknown.
    """
    declared_columns = declare_columns(flow, flow, 0)
    try:
        streams = [find(delivery) for delivery in deliveries()]
    except EvidenceError as error:
        return Measured.all_missing(declared_columns, error.what)
    if not streams:
        return Measured.all_missing(declared_columns, "no packet of the flow is in a capture")
    longest_s, count = max(stream.longest_s for stream in streams), sum(stream.count for stream in streams)
    if any(stream.is_open for stream in streams):
        values = {f"{flow}_stall_at_least_s": longest_s, f"{flow}_stalls": count}
        return Measured(values, {f"{flow}_stall_s": "a stall had not ended at the end of the flow"})
    values = {f"{flow}_stall_s": longest_s, f"{flow}_stalls": count}
    return Measured(values, {f"{flow}_stall_at_least_s": "every stall ended"})


TOPIC_COLUMNS = tuple(
    replace(column, meaning=column.meaning.replace("complete captures", "complete logs"))
    for column in declare_columns("topic", "the topic", 83)
)


def require_steady_clocks(flow: "TopicTraffic", sender: Packets | None, receiver: Packets | None) -> None:
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


def topic_delivery(sent: "TopicLog | None", received: "TopicLog | None", expected: FlowSchedule) -> Delivery:
    """Return the deliveries of a topic.

    Args:
        sent: Log of the publisher; None if it is incomplete.
        received: Log of the subscriber; None if it is incomplete.
        expected: Known properties of the stream.

    Raises:
        EvidenceError: The deliveries cannot be determined from the logs.
    """
    if sent is None or received is None:
        raise EvidenceError("there are no complete logs of both ends")
    samples = sent.samples
    if not len(samples):
        raise EvidenceError("nothing was sent")
    _, sent_index, received_index = np.intersect1d(samples.sequence, received.samples.sequence, return_indices=True)
    at_ns = received.samples.at_ns[np.sort(received_index)]
    if (np.diff(at_ns) < -deliveries.REORDERING_NS).any():
        raise EvidenceError("a sample is earlier than the one before it: a clock was set back")
    pairs = StampPairs(samples.sent_ns[sent_index], received.samples.at_ns[received_index])
    first_ns, last_ns = int(samples.sent_ns.min()), int(samples.sent_ns.max())
    return deliveries.stream_delivery(np.sort(at_ns), (first_ns, first_ns, last_ns), pairs, expected)


def measure_topic(
    flow: "TopicTraffic",
    logs: "tuple[TopicLog | None, TopicLog | None]",
    captured: tuple[Packets | None, Packets | None],
    expected: FlowSchedule,
) -> Measured:
    """Return the columns of the stalls of a topic.

    Args:
        flow: Identifies its packets.
        logs: Logs of publisher and subscriber as for `topic_delivery`.
        captured: Packets that their robots captured; None without a complete capture.
        expected: Known properties of the stream.
    """
    return measure("topic", lambda: read_topic_deliveries(flow, logs, captured, expected))


def read_topic_deliveries(
    flow: "TopicTraffic",
    logs: "tuple[TopicLog | None, TopicLog | None]",
    captured: tuple[Packets | None, Packets | None],
    expected: FlowSchedule,
) -> list[Delivery]:
    """Return the deliveries of a topic.

    Arguments as for `measure_topic`; raises as `topic_delivery` and `require_steady_clocks`.
    """
    require_steady_clocks(flow, *captured)
    return [topic_delivery(*logs, expected)]


def flow_schedule(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> FlowSchedule:
    """Return the known properties of a transfer; its sender always has more to send until the end of the file.

    Args:
        evidence: The attempt's evidence.
        transfer: The transfer.
        listener: Job that received the file; empty if unknown.
    """
    return FlowSchedule(
        size_bytes=evidence.read_or_none(reading.size, transfer.sent_file),
        until_ns=robot_clock.job_end_ns(evidence, transfer.destination, listener),
    )


def read_transfer_deliveries(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> list[Delivery]:
    """Return the deliveries of each connection; arguments as for `flow_schedule`.

    Raises:
        EvidenceError: They cannot be determined from the captures.
    """
    sender, receiver = (evidence.whole_capture(file) for file in transfer.captures)
    if sender is None or receiver is None:
        raise EvidenceError("there are no complete captures of both ends")
    schedule = flow_schedule(evidence, transfer, listener)
    if transfer.protocol is Protocol.UDP:
        return udp_deliveries(udp.match_transfer(sender.packets, receiver.packets, transfer), schedule)
    frames = tcp.match_transfer(sender.packets, receiver.packets, transfer)
    return tcp_deliveries(frames, transfer.backward(sender.packets), schedule)


def udp_deliveries(packets: UdpPackets, schedule: FlowSchedule) -> list[Delivery]:
    """Return the deliveries of a UDP transfer; errors as `deliveries.of_udp`."""
    return [deliveries.of_udp(packets, packets.is_transfer[:-1], schedule)]


def tcp_deliveries(frames: TcpFrames, answers: Packets, schedule: FlowSchedule) -> list[Delivery]:
    """Return the deliveries of each connection of a TCP transfer; errors as `deliveries.of_tcp`.

    Args:
        frames: Frames of the connections in both captures.
        answers: Packets from receiver to sender in the sender's capture.
        schedule: Known properties of the transfer.
    """
    ports = np.unique(frames.sent.sport)
    if len(ports) == 1:
        return [deliveries.of_tcp(frames, answers.where(answers.dport == ports[0]), schedule)]
    return [
        deliveries.of_tcp(
            tcp.match_frames(
                frames.sent.where(frames.sent.sport == port), frames.received.where(frames.received.sport == port)
            ),
            answers.where(answers.dport == port),
            schedule,
        )
        for port in ports
    ]
