"""Stalls of a flow: times during which new payload was overdue at its receiver.

A delivery is an arrival of new payload. In a flow with a fixed rate, payload is overdue from one sending interval
after the previous delivery on, so that the time in which the sender has nothing to send is not part of a stall. In
other flows, payload is overdue from the previous delivery on.

A stall is a time longer than `StreamDeliveries.min_stall_s` during which payload is overdue. The time before the
first payload, when a connection is established, and the time after the last payload are included only if they are
longer than this minimum. A stall after the last payload is right-censored: it had not ended when the flow ended.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Column, Figure, Kind, Measured, columns
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure import robot_clock
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence import reading
from fieldkit.measure.transfers import deliveries, tcp, udp
from fieldkit.measure.transfers.deliveries import FlowSchedule, StreamDeliveries
from fieldkit.measure.transfers.tcp import TcpFrames
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.measure.transfers.udp import UdpPackets

RANK: Final = 120
"""Rank of the columns in trial.csv: after the columns of earlier versions."""


@dataclass(frozen=True)
class Stalls:
    """Stalls of one or several streams.

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
        flow: Prefix of the columns' names, such as `transfer`.
        label: Name of the flow in the columns' labels, such as `the transfer`.
        rank: Rank of the columns' figures.
    """
    bound = f"{flow}_stall_at_least_s"
    return columns(
        RANK,
        (
            f"{flow}_stall_s",
            "s",
            (
                "Longest time during which new payload of a stream was overdue at the receiver. "
                "Empty if a stall had not ended, and without complete captures of both ends."
            ),
            Figure(f"longest stall of {label}", Kind.MEDIAN, rank=rank, at_least=bound),
        ),
        (
            f"{flow}_stalls",
            "count",
            (
                "Number of times that new payload of any stream was overdue for longer than the largest of 0.2 s, "
                "2 round trips of TCP's handshake, and 3 sending intervals."
            ),
            Figure(f"stalls of {label}", Kind.MEAN, rank=rank),
        ),
        (bound, "s", f"Lower bound of {flow}_stall_s if a stall had not ended; otherwise empty."),
    )


def cross_checks(flow: str) -> tuple[CrossCheck, ...]:
    """Return the sources of the columns for a kind of flow, and the cross-checks between these sources."""
    return (
        CrossCheck(
            quantity="time without new payload at the receiver",
            columns=(f"{flow}_stall_s", f"{flow}_stalls", f"{flow}_stall_at_least_s"),
            source="receiver's capture: times of the frames that deliver new payload",
            against=(
                "sender's capture: the same packets, and the clock offset that fits both captures",
                "`ROLE-before.txt` and `ROLE-after.txt`: clocks that were set",
            ),
            tolerance="packets may be out of order by 0.1 s, because two processors capture them",
            outcome=CheckOutcome.WITHHELD,
        ),
    )


def find_stalls(stream: StreamDeliveries) -> Stalls:
    """Return the stalls of a stream.

    Raises:
        EvidenceError: No time can be computed, because a single packet arrived without a stall before or after it, or
            because no packet arrived and only one was sent.
    """
    at_ns, min_stall_s = stream.at_ns, stream.min_stall_s
    if not len(at_ns):
        return _stall_without_arrivals(stream)
    overdue_s = np.maximum(np.diff(at_ns) / 1e9 - stream.interval_s, 0.0)
    before_s = (int(at_ns[0]) - stream.begin_ns) / 1e9
    after_s = 0.0
    if stream.end_ns is not None:
        after_s = (stream.end_ns - int(at_ns[-1])) / 1e9 - stream.interval_s
    edge_stalls_s = [seconds for seconds in (before_s, after_s) if seconds > min_stall_s]
    if not len(overdue_s) and not edge_stalls_s:
        raise EvidenceError("only one packet of the flow arrived, so no time can be computed")
    return Stalls(
        longest_s=max(float(overdue_s.max(initial=0.0)), *edge_stalls_s, 0.0),
        count=int((overdue_s > min_stall_s).sum()) + len(edge_stalls_s),
        is_open=after_s > min_stall_s,
    )


def _stall_without_arrivals(stream: StreamDeliveries) -> Stalls:
    """Return the stall of a stream without arrivals; it has the stream's whole duration.

    Raises:
        EvidenceError: The stream has no duration, because a single packet was sent.
    """
    duration_s = ((stream.end_ns or stream.begin_ns) - stream.begin_ns) / 1e9
    if duration_s <= 0:
        raise EvidenceError("no packet of the flow arrived, and only one was sent")
    return Stalls(duration_s, 1, is_open=True)


def measure(flow: str, deliveries: Callable[[], Sequence[StreamDeliveries]]) -> Measured:
    """Return the columns for a flow.

    Args:
        flow: Prefix of the columns' names; see `declare_columns`.
        deliveries: Function that returns the deliveries of each stream; raises `EvidenceError` if they are unknown.
    """
    declared_columns = declare_columns(flow, flow, 0)  # only the names are used, so label and rank have no effect
    try:
        streams = [find_stalls(stream) for stream in deliveries()]
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


def flow_schedule(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> FlowSchedule:
    """Return the known properties of a transfer. Its sender always has data to send until the end of the file.

    Args:
        evidence: The attempt's evidence.
        transfer: The transfer.
        listener: Name of the job that received the file; empty if unknown.
    """
    return FlowSchedule(
        size_bytes=evidence.read_or_none(reading.size, transfer.sent_file),
        receiver_end_ns=robot_clock.job_end_ns(evidence, transfer.destination, listener),
    )


def read_transfer_deliveries(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> list[StreamDeliveries]:
    """Return the deliveries of each connection. The arguments are the same as for `flow_schedule`.

    Raises:
        EvidenceError: The deliveries cannot be determined from the captures.
    """
    sender, receiver = (evidence.undamaged_capture(file) for file in transfer.captures)
    if sender is None or receiver is None:
        raise EvidenceError("there are no complete captures of both ends")
    schedule = flow_schedule(evidence, transfer, listener)
    if transfer.protocol is Protocol.UDP:
        return udp_deliveries(udp.match_transfer(sender.packets, receiver.packets, transfer), schedule)
    frames = tcp.match_transfer(sender.packets, receiver.packets, transfer)
    return tcp_deliveries(frames, transfer.backward(sender.packets), schedule)


def udp_deliveries(packets: UdpPackets, schedule: FlowSchedule) -> list[StreamDeliveries]:
    """Return the deliveries of a UDP transfer. Raises the same errors as `deliveries.udp_stream_deliveries`."""
    return [deliveries.udp_stream_deliveries(packets, packets.is_transfer_datagram[:-1], schedule)]


def tcp_deliveries(frames: TcpFrames, answers: Packets, schedule: FlowSchedule) -> list[StreamDeliveries]:
    """Return the deliveries of each connection of a TCP transfer.

    Raises the same errors as `deliveries.tcp_stream_deliveries`.

    Args:
        frames: Frames of the connections in both captures.
        answers: Packets from receiver to sender in the sender's capture.
        schedule: Known properties of the transfer.
    """
    ports = np.unique(frames.sent.sport)
    if len(ports) == 1:
        return [deliveries.tcp_stream_deliveries(frames, answers.where(answers.dport == ports[0]), schedule)]
    return [
        deliveries.tcp_stream_deliveries(
            tcp.match_frames(
                frames.sent.where(frames.sent.sport == port), frames.received.where(frames.received.sport == port)
            ),
            answers.where(answers.dport == port),
            schedule,
        )
        for port in ports
    ]
