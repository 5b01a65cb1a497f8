"""Loss of a TCP transfer, counted by sequence ranges.

A byte is told by its sequence number (RFC 9293, section 3.4), so neither segmentation offload, which lets a capture
see frames of many segments, nor reordering, duplicates, retransmissions or partial overlaps change what is counted.
"""

from dataclasses import dataclass

import numpy as np

from fieldkit.measure.captures.arrays import Mask
from fieldkit.measure.captures.packets import SYN, Packets
from fieldkit.measure.transfers.match import NONE, Payload, match_payload, reordered
from fieldkit.measure.transfers.ranges import Pieces
from fieldkit.measure.transfers.transfer import Transfer, span_s


@dataclass(frozen=True, eq=False)
class TcpFrames:
    """Frames of a TCP transfer's connections from sender to receiver in both captures, beside each other.

    Attributes:
        sent: In the sender's capture.
        received: In the receiver's.
        payload: Which piece of payload of these is a copy of which of those.
        mss_bytes: The largest MSS that a SYN of either end announced; 0 when none says it.
    """

    sent: Packets
    received: Packets
    payload: Payload
    mss_bytes: int


@dataclass(frozen=True)
class TcpCounts:
    """Counts of what left the sender, and of what reached the receiver's interface.

    Attributes:
        frames_sent: Frames captured at the sender, those without payload too.
        frames_received: Frames captured at the receiver; offload may make them more or fewer.
        sent_bytes: Payload bytes sent, retransmissions included.
        unique_bytes: Payload bytes sent, each sequence number once.
        received_bytes: Of the payload bytes sent, those that arrived; a copy that was not sent counts nowhere.
        lost_bytes: Of the unique bytes, the ones that never reached the receiver.
        duplicated_bytes: Payload bytes received beyond the first copy of each sequence number.
        retransmitted_frames: Frames whose range had been sent before, wholly or in part.
        spurious_frames: Frames of which every byte had been sent before in a frame that reached the receiver, be it
            before or after. None where frames are doubtful.
        reordered_frames: Frames received whose first byte was sent before one that had arrived, in whatever frame; of
            several copies the first counts. None where frames are doubtful.
        superframes: Frames of either capture with more payload than the largest MSS that a SYN announced: offload
            made several segments one. None when no SYN says it.
        doubtful_frames: Frames with bytes that were sent several times and arrived, where neither time stamps nor IP
            ids nor the time between them tell which of them did.
        dubious_frames: Frames received that may be copies that hide a loss: see `Match.dubious`.
        transfer_s: First frame to last payload frame at the receiver, in seconds; None without payload.
    """

    frames_sent: int
    frames_received: int
    sent_bytes: int
    unique_bytes: int
    received_bytes: int
    lost_bytes: int
    duplicated_bytes: int
    retransmitted_frames: int
    spurious_frames: int | None
    reordered_frames: int | None
    superframes: int | None
    doubtful_frames: int
    dubious_frames: int
    transfer_s: float | None


def cross(sender: Packets, receiver: Packets, transfer: Transfer) -> TcpFrames:
    """Return the frames of a TCP transfer in both captures beside each other.

    A connection counts if its SYN left the sender while it captured: what the kernel still repeats of an earlier
    transfer, for minutes where that one broke off, is not this one's.

    Raises:
        EvidenceError: See `ranges.cut`.
    """
    sent, received = (
        forward.where(forward.dport == transfer.port)
        for forward in (transfer.forward(sender), transfer.forward(receiver))
    )
    begun = np.isin(sent.sport, np.unique(sent.sport[sent.tcp_flags & SYN != 0]))
    sent = sent.where(begun)
    received = received.where(np.isin(received.sport, sent.sport))
    return TcpFrames(sent, received, match_payload(sent, received), _mss_bytes(sender, receiver, transfer.port))


def beside(sent: Packets, received: Packets) -> TcpFrames:
    """Return TCP frames of one direction in both captures beside each other; errors as `cross`."""
    return TcpFrames(sent, received, match_payload(sent, received), 0)


def count(crossing: TcpFrames) -> TcpCounts:
    """Return the counts of a TCP transfer; connections are summed."""
    sent, received, carried = crossing.sent, crossing.received, crossing.payload
    left, came = carried.sent, carried.received
    stretches = max(left.stretch.max(initial=-1), came.stretch.max(initial=-1)) + 1
    times_sent, times_received = (np.bincount(these.stretch, minlength=stretches) for these in (left, came))
    doubtful = len(np.unique(left.frame[carried.match.doubtful]))
    size_bytes = np.zeros(stretches, dtype=np.int64)
    size_bytes[left.stretch], size_bytes[came.stretch] = left.size_bytes, came.size_bytes
    return TcpCounts(
        frames_sent=len(sent),
        frames_received=len(received),
        sent_bytes=int(left.size_bytes.sum()),
        unique_bytes=int(size_bytes[times_sent > 0].sum()),
        received_bytes=int(left.size_bytes[carried.match.arrived].sum()),
        lost_bytes=int(size_bytes[(times_sent > 0) & (times_received == 0)].sum()),
        duplicated_bytes=int((np.maximum(times_received - 1, 0) * size_bytes).sum()),
        retransmitted_frames=int(sent_again(crossing).sum()),
        spurious_frames=None if doubtful else _spurious(carried),
        reordered_frames=None if doubtful else _reordered(carried),
        superframes=_superframes(crossing),
        doubtful_frames=doubtful,
        dubious_frames=len(np.unique(came.frame[carried.match.dubious])),
        transfer_s=span_s(received.time_ns, received.tcp_payload_bytes > 0),
    )


def _follow(pieces: Pieces, others: Pieces) -> Mask:
    """Return which pieces are in a later frame than the first of `others` with the same bytes."""
    earliest = np.full(
        max(pieces.stretch.max(initial=-1), others.stretch.max(initial=-1)) + 1, np.iinfo(np.int64).max
    )
    # Of several values for one place numpy keeps the last, here that of the earliest frame.
    earliest[others.stretch[::-1]] = others.frame[::-1]
    follow: Mask = pieces.frame > earliest[pieces.stretch]
    return follow


def sent_again(crossing: TcpFrames) -> Mask:
    """Return which frames sent have bytes that had been sent before. Of the shape of `crossing.sent`."""
    again = np.zeros(len(crossing.sent), dtype=np.bool_)
    again[crossing.payload.sent.frame[_follow(crossing.payload.sent, crossing.payload.sent)]] = True
    return again


def _spurious(carried: Payload) -> int:
    """Return how many frames repeated nothing but what reaches the receiver from earlier ones."""
    needless = _follow(carried.sent, carried.sent.where(carried.match.arrived))
    return len(np.unique(carried.sent.frame)) - len(np.unique(carried.sent.frame[~needless]))


def _reordered(carried: Payload) -> int:
    """Return how many frames received were overtaken by bytes that were sent later."""
    first_copies = np.flatnonzero((carried.match.sent_index != NONE) & ~carried.match.duplicates)
    late = first_copies[reordered(carried.match.sent_index[first_copies])]
    return int(np.isin(np.unique(carried.received.frame, return_index=True)[1], late).sum())


def _mss_bytes(sender: Packets, receiver: Packets, port: int) -> int:
    return max(
        int(packets.tcp_mss[(packets.sport == port) | (packets.dport == port)].max(initial=0))
        for packets in (sender, receiver)
    )


def _superframes(crossing: TcpFrames) -> int | None:
    mss = crossing.mss_bytes
    both = crossing.sent, crossing.received
    return sum(int((packets.tcp_payload_bytes > mss).sum()) for packets in both) if mss else None
