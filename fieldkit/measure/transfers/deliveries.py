"""New payload of a flow at its receiver: from when on it was due, and when it arrived.

TCP delivers bytes in order, each once (RFC 9293, section 3.10.7.4): a frame is a delivery if it makes the run of
bytes without a hole longer. UDP delivers whole datagrams. A retransmitted copy, a duplicate, a fragment and a segment
behind a hole deliver nothing by themselves, so segmentation offload changes no time by more than one frame.

All times are those of the receiver's capture. Times of the sender are moved there by the fastest packet of the flow
that both captures hold, so that a packet sent then would have arrived at the earliest.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.packets import ACK, SYN, Packets
from fieldkit.measure.transfers import delay, ranges, udp
from fieldkit.measure.transfers.clocks import StampPairs
from fieldkit.measure.transfers.datagrams import NO_DATAGRAM
from fieldkit.measure.transfers.tcp import TcpFrames
from fieldkit.measure.transfers.udp import UdpPackets

LEAST_STALL_S: Final = 0.2
"""Least length of a stall: the least retransmission time-out of Linux (TCP_RTO_MIN), so what TCP repairs by a fast
retransmission is not a stall."""

_RTTS: Final = 2
"""A fast retransmission delivers a lost segment one round trip late, and a queue may double that."""

_INTERVALS: Final = 3
"""Of a flow at a rate: one or two payloads lost in a row are a loss, and no stall."""

_NEIGHBOURS: Final = 100
"""Packets at either end of a flow of which the fastest moves times of the sender: within them clocks do not drift."""

BACK_NS: Final = 100_000_000
"""Packets that two processors took in may be in another order by less; by more the clock was set back."""


@dataclass(frozen=True)
class FlowSchedule:
    """What is known of a flow before it is captured.

    Attributes:
        interval_s: Time between two payloads where they are sent at a rate; 0 where the sender always has more.
        lasts_s: How long it sends, from its first payload on; None if it ends when all is sent.
        size_bytes: Payload of a TCP flow; None if only its capture shows it.
        until_ns: When the receiving program ended, by the receiver's clock; None if that is unknown.
        head_bytes: Bytes at the beginning of a TCP flow that belong to its setup.
    """

    interval_s: float = 0.0
    lasts_s: float | None = None
    size_bytes: int | None = None
    until_ns: int | None = None
    head_bytes: int = 0


@dataclass(frozen=True, eq=False)
class Delivery:
    """New payload of one stream; times in nanoseconds since 1970 UTC by the receiver's clock.

    Attributes:
        at_ns: When each new payload arrived, in order. Shape (n,).
        begin_ns: When the stream began: its first packet, of TCP its SYN. By the sender's clock if nothing arrived.
        end_ns: Until when payload was due; None if all of it arrived. By the sender's clock if nothing arrived.
        interval_s: As `FlowSchedule.interval_s`.
        least_s: Payload that is overdue for longer is a stall.
    """

    at_ns: Ints
    begin_ns: int
    end_ns: int | None
    interval_s: float
    least_s: float


def of_udp(crossing: UdpPackets, chosen: Mask, expected: FlowSchedule) -> Delivery:
    """Return the deliveries of datagrams.

    Args:
        crossing: UDP packets of both captures.
        chosen: Which datagrams sent are of the stream. Shape (k,).
        expected: What is known of it.

    Raises:
        EvidenceError: The captures do not show it.
    """
    matched = crossing.match
    mine = np.append(chosen, False)[crossing.datagram]  # the last entry is that of NO_DATAGRAM
    came = np.append(mine, False)[matched.sent_index]  # that of match.NONE
    if (came & matched.dubious).any():
        raise EvidenceError("packets of it look alike, and some that arrived may be copies")
    sent_ns = crossing.sent.time_ns[mine]
    _demand_times(sent_ns, crossing.received.time_ns[came])
    whole_ns = arrivals_ns(crossing)[chosen]
    at_ns = np.sort(whole_ns[whole_ns != NO_TIME])
    index = np.flatnonzero(mine & matched.arrived)
    pairs = StampPairs(crossing.sent.time_ns[index], crossing.received.time_ns[matched.received_index[index]])
    return of_stream(at_ns, (int(sent_ns.min()), int(sent_ns.min()), int(sent_ns.max())), pairs, expected)


def arrivals_ns(crossing: UdpPackets) -> Ints:
    """Return when the last fragment of each datagram sent arrived; `NO_TIME` where not all did. Shape (k,)."""
    index = np.flatnonzero((crossing.datagram != NO_DATAGRAM) & crossing.match.arrived)
    last_ns = np.full(len(crossing.first), NO_TIME)
    np.maximum.at(last_ns, crossing.datagram[index], crossing.received.time_ns[crossing.match.received_index[index]])
    return np.where(udp.whole(crossing)[:-1], last_ns, NO_TIME)


def of_tcp(frames: TcpFrames, answers: Packets, expected: FlowSchedule) -> Delivery:
    """Return the deliveries of one TCP connection in one direction.

    Args:
        frames: Its frames in both captures.
        answers: Packets of the other direction in the sender's capture.
        expected: What is known of it.

    Raises:
        EvidenceError: The captures do not show it.
    """
    sent, received = frames.sent, frames.received
    _demand_times(sent.time_ns, received.time_ns)
    place, reached = in_order(received)
    _, offered = in_order(sent)
    beyond = reached > expected.head_bytes
    # Two processors may have taken in two packets in another order.
    at_ns = np.maximum.accumulate(received.time_ns[place])[beyond]
    delivered, left = (int(bytes_[-1]) if len(bytes_) else 0 for bytes_ in (reached, offered))
    whole = delivered >= max(left, expected.size_bytes or 0, expected.head_bytes + 1)
    data = sent.tcp_payload_bytes > expected.head_bytes
    first_ns = int(sent.time_ns.min())
    data_ns = int(sent.time_ns[data].min()) if data.any() else first_ns
    last_ns = max(int(sent.time_ns[sent.tcp_payload_bytes > 0].max(initial=first_ns)), _syn_ns(sent, first_ns))
    left_index, came_index = delay.tcp_copies(frames)
    pairs = StampPairs(sent.time_ns[left_index], received.time_ns[came_index])
    found = of_stream(at_ns, (first_ns, data_ns, last_ns), pairs, expected, rtt_s=_rtt_s(sent, answers))
    if expected.lasts_s is not None or not len(at_ns):
        return found
    if whole:
        return replace(found, end_ns=None)
    # A receiver that knows how much is to come waits for it until it is ended.
    return (
        found
        if expected.size_bytes is None or expected.until_ns is None
        else replace(found, end_ns=expected.until_ns)
    )


def in_order(frames: Packets) -> tuple[Ints, Ints]:
    """Return which frames make the run of bytes without a hole longer, and how long it is with each.

    Args:
        frames: Those of one TCP connection in one direction, in the order of the capture.

    Raises:
        EvidenceError: See `ranges.cut`.
    """
    # Where SYN is, it says where the first byte has its place; an RST may have any number.
    mine = np.flatnonzero((frames.tcp_payload_bytes > 0) | (frames.tcp_flags & SYN != 0))
    chosen = frames.where(mine)
    _, pieces = ranges.cut(chosen.where(slice(0, 0)), chosen)
    never = len(chosen)
    count = int(pieces.stretch.max(initial=-1)) + 1
    first, size_bytes = np.full(count, never), np.zeros(count, dtype=np.int64)
    # Of several values for one place numpy keeps the last, here that of the earliest frame.
    first[pieces.stretch[::-1]] = pieces.frame[::-1]
    size_bytes[pieces.stretch] = pieces.size_bytes
    reached = np.maximum.accumulate(first)
    reached = reached[reached < never]
    last_of_frame = np.flatnonzero(np.diff(reached, append=never))
    return mine[reached[last_of_frame]], np.cumsum(size_bytes[: len(reached)])[last_of_frame]


def of_stream(
    at_ns: Ints, sent_ns: tuple[int, int, int], pairs: StampPairs, expected: FlowSchedule, *, rtt_s: float = 0.0
) -> Delivery:
    """Return the deliveries of a stream that was due until its last payload was, or until its time was over.

    Args:
        at_ns: Times of delivery.
        sent_ns: When its sender sent its first packet, its first payload and its last one.
        pairs: Its packets that both captures hold.
        expected: What is known of it.
        rtt_s: Round-trip time of a stream that sends again what was lost.
    """
    least_s = max(LEAST_STALL_S, _RTTS * rtt_s, _INTERVALS * expected.interval_s)
    first_ns, data_ns, last_ns = sent_ns
    if expected.lasts_s is not None:
        last_ns = data_ns + round(1e9 * expected.lasts_s)
    if not len(at_ns):
        return Delivery(at_ns, first_ns, last_ns, expected.interval_s, least_s)
    early_ns, late_ns = _ahead_ns(pairs)
    end_ns = last_ns + late_ns
    if expected.lasts_s is not None and expected.until_ns is not None:
        end_ns = min(end_ns, expected.until_ns)
    return Delivery(at_ns, first_ns + early_ns, end_ns, expected.interval_s, least_s)


def _ahead_ns(pairs: StampPairs) -> tuple[int, int]:
    """Return what to add to times of the sender at the beginning and at the end of a flow."""
    if not len(pairs):
        raise EvidenceError("nothing shows which of its packets arrived when")
    order = np.argsort(pairs.receiver_ns, kind="stable")
    ends = pairs.where(order[:_NEIGHBOURS]), pairs.where(order[-_NEIGHBOURS:])
    early_ns, late_ns = (int((part.receiver_ns - part.sender_ns).min()) for part in ends)
    return early_ns, late_ns


def _demand_times(sent_ns: Ints, received_ns: Ints) -> None:
    """Refuse captures that do not tell how much time passed."""
    if not len(sent_ns):
        raise EvidenceError("no packet of it is in the sender's capture")
    for times_ns in (sent_ns, received_ns):
        if (times_ns == NO_TIME).any():
            raise EvidenceError("a capture lacks times")
        if (np.diff(times_ns) < -BACK_NS).any():
            raise EvidenceError("a packet is earlier than the one before it: a clock was set back")


def _syn_ns(sent: Packets, first_ns: int) -> int:
    """Return when the last SYN was sent, of a connection that may never have been made."""
    return int(sent.time_ns[sent.tcp_flags & SYN != 0].max(initial=first_ns))


def _rtt_s(sent: Packets, answers: Packets) -> float:
    """Return the round-trip time of the handshake at the sender; 0 where its capture does not have it."""
    acknowledges = answers.time_ns[answers.tcp_flags & ACK != 0]
    opens_ns = sent.time_ns[sent.tcp_flags & SYN != 0]
    if not len(acknowledges) or not (before := opens_ns[opens_ns <= acknowledges[0]]).size:
        return 0.0
    return float(acknowledges[0] - before[-1]) / 1e9
