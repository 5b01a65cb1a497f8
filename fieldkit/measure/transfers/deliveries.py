"""Deliveries of new payload of a flow at its receiver, and the period in which payload was due.

TCP delivers bytes in order, each once (RFC 9293, section 3.10.7.4): a frame is a delivery if it extends the
contiguous received bytes. UDP delivers complete datagrams. A retransmitted copy, a duplicate, a fragment that does
not complete its datagram and a segment after a gap are not deliveries. Segmentation offload changes the time of a
delivery by at most one frame.

All times are by the clock of the receiver's capture. The sender's times are converted with the fastest packet of the
flow that is in both captures, so that a converted time is the earliest possible arrival.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.packets import ACK, SYN, Packets
from fieldkit.measure.transfers import delay, tcp_streams, udp
from fieldkit.measure.transfers.clock_offset import StampPairs
from fieldkit.measure.transfers.tcp import TcpFrames
from fieldkit.measure.transfers.udp import NO_DATAGRAM, UdpPackets

MIN_STALL_S: Final = 0.2
"""Minimum length of a stall: the minimum retransmission timeout of Linux (TCP_RTO_MIN). A loss that TCP repairs by a
fast retransmission is therefore not a stall."""

_MIN_RTTS: Final = 2
"""A stall is longer than this many round trips: a fast retransmission delivers a lost segment one round trip late,
and a queue may double this delay."""

_MIN_INTERVALS: Final = 3
"""A stall of a flow with a fixed rate is longer than this many sending intervals: the loss of one or two consecutive
payloads is not a stall."""

_EDGE_PACKETS: Final = 100
"""Number of packets at the start and at the end of a flow from which the clock offset is computed. The drift during
these packets is negligible."""

REORDERING_NS: Final = 100_000_000
"""If two processors capture packets, their times may be out of order by less than this. A larger difference shows
that the clock was set back."""


@dataclass(frozen=True)
class FlowSchedule:
    """Properties of a flow that are known without its captures.

    Attributes:
        interval_s: Sending interval of a flow with a fixed rate; 0 if the sender always has data to send.
        duration_s: Sending duration from the first payload on; None if the flow ends when all data is sent.
        size_bytes: Payload of a TCP flow; None if it is not known in advance.
        receiver_end_ns: Time at which the receiving program exited, by the receiver's clock; None if unknown.
        head_bytes: Number of bytes at the start of a TCP flow that belong to its setup.
    """

    interval_s: float = 0.0
    duration_s: float | None = None
    size_bytes: int | None = None
    receiver_end_ns: int | None = None
    head_bytes: int = 0


@dataclass(frozen=True, eq=False)
class StreamDeliveries:
    """Deliveries of new payload of one stream; times in nanoseconds since 1970 UTC by the receiver's clock.

    If nothing arrived, `begin_ns` and `end_ns` are by the sender's clock.

    Attributes:
        at_ns: Times of arrival of new payload, ascending. Shape (n,).
        begin_ns: Time of the first packet of the stream, which is the SYN for TCP.
        end_ns: Time until which payload was due; None if all payload of a TCP stream without a fixed duration
            arrived.
        interval_s: Sending interval; see `FlowSchedule.interval_s`.
        min_stall_s: Minimum length of a stall: payload is overdue for longer than this.
    """

    at_ns: Ints
    begin_ns: int
    end_ns: int | None
    interval_s: float
    min_stall_s: float


def udp_stream_deliveries(packets: UdpPackets, in_stream: Mask, schedule: FlowSchedule) -> StreamDeliveries:
    """Return the deliveries of datagrams.

    Args:
        packets: UDP packets of both captures.
        in_stream: Mask of the sent datagrams that belong to the stream. Shape (k,).
        schedule: Known properties of the stream.

    Raises:
        EvidenceError: The deliveries cannot be determined from the captures.
    """
    matched = packets.match
    # The indices `NO_DATAGRAM` and `match.NONE` are -1, and select the appended False.
    stream_packets = np.append(in_stream, False)[packets.datagram]
    received_packets = np.append(stream_packets, False)[matched.sent_index]
    if (received_packets & matched.possible_copy).any():
        raise EvidenceError("packets of the flow cannot be distinguished, and received packets may be copies")
    sent_ns = packets.sent.time_ns[stream_packets]
    require_times(sent_ns, packets.received.time_ns[received_packets])
    complete_ns = arrivals_ns(packets)[in_stream]
    at_ns = np.sort(complete_ns[complete_ns != NO_TIME])
    index = np.flatnonzero(stream_packets & matched.arrived)
    pairs = StampPairs(packets.sent.time_ns[index], packets.received.time_ns[matched.received_index[index]])
    return stream_deliveries(at_ns, (int(sent_ns.min()), int(sent_ns.min()), int(sent_ns.max())), pairs, schedule)


def arrivals_ns(packets: UdpPackets) -> Ints:
    """Return the arrival time of each sent datagram's last fragment; `NO_TIME` if it is incomplete. Shape (k,)."""
    index = np.flatnonzero((packets.datagram != NO_DATAGRAM) & packets.match.arrived)
    last_ns = np.full(len(packets.first), NO_TIME)
    np.maximum.at(last_ns, packets.datagram[index], packets.received.time_ns[packets.match.received_index[index]])
    return np.where(udp.complete(packets)[:-1], last_ns, NO_TIME)


def tcp_stream_deliveries(frames: TcpFrames, answers: Packets, schedule: FlowSchedule) -> StreamDeliveries:
    """Return the deliveries of one TCP connection in one direction.

    Args:
        frames: Frames of the connection in both captures.
        answers: Packets of the other direction in the sender's capture.
        schedule: Known properties of the connection.

    Raises:
        EvidenceError: The deliveries cannot be determined from the captures.
    """
    sent, received = frames.sent, frames.received
    require_times(sent.time_ns, received.time_ns)
    advancing, received_contiguous = advancing_frames(received)
    _, sent_contiguous = advancing_frames(sent)
    has_payload = received_contiguous > schedule.head_bytes
    # Two processors may have captured two packets in the wrong order.
    at_ns = np.maximum.accumulate(received.time_ns[advancing])[has_payload]
    delivered_bytes, sent_bytes = (
        int(contiguous_bytes[-1]) if len(contiguous_bytes) else 0
        for contiguous_bytes in (received_contiguous, sent_contiguous)
    )
    is_complete = delivered_bytes >= max(sent_bytes, schedule.size_bytes or 0, schedule.head_bytes + 1)
    data = sent.tcp_payload_bytes > schedule.head_bytes
    first_ns = int(sent.time_ns.min())
    data_ns = int(sent.time_ns[data].min()) if data.any() else first_ns
    last_ns = max(int(sent.time_ns[sent.tcp_payload_bytes > 0].max(initial=first_ns)), _last_syn_ns(sent, first_ns))
    sent_index, received_index = delay.tcp_pair_indices(frames)
    pairs = StampPairs(sent.time_ns[sent_index], received.time_ns[received_index])
    stream = stream_deliveries(at_ns, (first_ns, data_ns, last_ns), pairs, schedule, rtt_s=_rtt_s(sent, answers))
    if schedule.duration_s is not None or not len(at_ns):
        return stream
    if is_complete:
        return replace(stream, end_ns=None)
    # A receiver of a known number of bytes waits for the missing bytes until it is terminated.
    return (
        stream
        if schedule.size_bytes is None or schedule.receiver_end_ns is None
        else replace(stream, end_ns=schedule.receiver_end_ns)
    )


def advancing_frames(frames: Packets) -> tuple[Ints, Ints]:
    """Return the indices of the frames that extend the contiguous bytes of a connection.

    The second array has the number of contiguous bytes after each of these frames.

    Args:
        frames: Frames of one TCP connection in one direction, in the order of the capture.

    Raises:
        EvidenceError: For the same reasons as `tcp_streams.cut`.
    """
    # SYN frames are included, because they define the position of the first byte. The number in an RST is arbitrary.
    relevant = np.flatnonzero((frames.tcp_payload_bytes > 0) | (frames.tcp_flags & SYN != 0))
    relevant_frames = frames.where(relevant)
    _, pieces = tcp_streams.cut(relevant_frames.where(slice(0, 0)), relevant_frames)
    no_frame = len(relevant_frames)
    count = int(pieces.range_id.max(initial=-1)) + 1
    first, size_bytes = np.full(count, no_frame), np.zeros(count, dtype=np.int64)
    # If an index occurs several times, numpy stores the last value: the earliest frame, because the order is
    # reversed.
    first[pieces.range_id[::-1]] = pieces.frame[::-1]
    size_bytes[pieces.range_id] = pieces.size_bytes
    completed_by = np.maximum.accumulate(first)
    completed_by = completed_by[completed_by < no_frame]
    last_of_frame = np.flatnonzero(np.diff(completed_by, append=no_frame))
    return relevant[completed_by[last_of_frame]], np.cumsum(size_bytes[: len(completed_by)])[last_of_frame]


def stream_deliveries(
    at_ns: Ints, sent_ns: tuple[int, int, int], pairs: StampPairs, schedule: FlowSchedule, *, rtt_s: float = 0.0
) -> StreamDeliveries:
    """Return the deliveries of a stream.

    Payload was due for the known duration of the stream, but at most until the receiving program exited. Without a
    known duration, it was due until the last payload was sent.

    Args:
        at_ns: Times at which new payload of the stream arrived, ascending.
        sent_ns: Times at which the sender sent the first packet, the first payload and the last payload.
        pairs: Packets of the stream that are in both captures.
        schedule: Known properties of the stream.
        rtt_s: Round-trip time if the stream retransmits lost data, otherwise 0.
    """
    min_stall_s = max(MIN_STALL_S, _MIN_RTTS * rtt_s, _MIN_INTERVALS * schedule.interval_s)
    first_ns, data_ns, last_ns = sent_ns
    if schedule.duration_s is not None:
        last_ns = data_ns + round(1e9 * schedule.duration_s)
    if not len(at_ns):
        return StreamDeliveries(at_ns, first_ns, last_ns, schedule.interval_s, min_stall_s)
    start_offset_ns, end_offset_ns = _sender_to_receiver_ns(pairs)
    end_ns = last_ns + end_offset_ns
    if schedule.duration_s is not None and schedule.receiver_end_ns is not None:
        end_ns = min(end_ns, schedule.receiver_end_ns)
    return StreamDeliveries(at_ns, first_ns + start_offset_ns, end_ns, schedule.interval_s, min_stall_s)


def _sender_to_receiver_ns(pairs: StampPairs) -> tuple[int, int]:
    """Return the offsets in ns that convert the sender's times at the start and at the end of a flow.

    Raises:
        EvidenceError: There are no pairs.
    """
    if not len(pairs):
        raise EvidenceError("no packet of the flow is known to be in both captures")
    order = np.argsort(pairs.receiver_ns, kind="stable")
    edge_pairs = pairs.where(order[:_EDGE_PACKETS]), pairs.where(order[-_EDGE_PACKETS:])
    start_offset_ns, end_offset_ns = (int((edge.receiver_ns - edge.sender_ns).min()) for edge in edge_pairs)
    return start_offset_ns, end_offset_ns


def require_times(sent_ns: Ints, received_ns: Ints) -> None:
    """Check that the times in the captures can be used to compute durations.

    Raises:
        EvidenceError: The sender's capture has no packet of the flow, a time is missing, or a clock was set back.
    """
    if not len(sent_ns):
        raise EvidenceError("no packet of the flow is in the sender's capture")
    for times_ns in (sent_ns, received_ns):
        if (times_ns == NO_TIME).any():
            raise EvidenceError("a capture lacks times")
        if (np.diff(times_ns) < -REORDERING_NS).any():
            raise EvidenceError("a packet is earlier than the one before it: a clock was set back")


def _last_syn_ns(sent: Packets, first_ns: int) -> int:
    """Return the time of the last SYN, which the sender repeats if the connection is not established."""
    return int(sent.time_ns[sent.tcp_flags & SYN != 0].max(initial=first_ns))


def _rtt_s(sent: Packets, answers: Packets) -> float:
    """Return the round-trip time of the handshake at the sender, or 0 if the handshake was not captured."""
    acknowledged_ns = answers.time_ns[answers.tcp_flags & ACK != 0]
    syn_ns = sent.time_ns[sent.tcp_flags & SYN != 0]
    if not len(acknowledged_ns) or not (earlier_syn_ns := syn_ns[syn_ns <= acknowledged_ns[0]]).size:
        return 0.0
    return float(acknowledged_ns[0] - earlier_syn_ns[-1]) / 1e9
