"""Loss of a TCP transfer, counted by sequence ranges.

A byte is identified by its sequence number (RFC 9293, section 3.4). The counts are therefore independent of
reordering, duplicates, retransmissions, partial overlaps, and segmentation offload, which joins segments into larger
frames.
"""

from dataclasses import dataclass

import numpy as np

from fieldkit.measure.captures.arrays import Mask
from fieldkit.measure.captures.packets import SYN, Packets
from fieldkit.measure.transfers.match import NONE, Payload, match_payload, reordered
from fieldkit.measure.transfers.tcp_streams import Pieces
from fieldkit.measure.transfers.transfer_spec import Transfer, span_s


@dataclass(frozen=True, eq=False)
class TcpFrames:
    """Frames of a TCP transfer's connections from sender to receiver in both captures.

    Attributes:
        sent: Frames in the sender's capture.
        received: Frames in the receiver's capture.
        payload: Match between the pieces of payload of both captures.
        mss_bytes: Largest MSS in a SYN of either end; 0 if no SYN has an MSS, and from `match_frames`.
    """

    sent: Packets
    received: Packets
    payload: Payload
    mss_bytes: int


@dataclass(frozen=True)
class TcpCounts:
    """Counts of frames and bytes that left the sender and that reached the receiver's interface.

    Attributes:
        frames_sent: Frames in the sender's capture, including frames without payload.
        frames_received: Frames in the receiver's capture. Offload may change the number of frames.
        sent_bytes: Sent payload bytes, including retransmissions.
        unique_bytes: Sent payload bytes; each sequence number is counted once.
        received_bytes: Sent payload bytes that arrived; copies that the network created are not counted.
        lost_bytes: Unique bytes that never reached the receiver.
        duplicated_bytes: Received payload bytes without the first copy of each sequence number.
        retransmitted_frames: Frames with bytes that had been sent before.
        spurious_frames: Frames that were not necessary, because each of their bytes had been sent before in a frame
            that reached the receiver at any time. None if frames are ambiguous.
        reordered_frames: Received frames whose first byte was sent before a byte that had already arrived; only the
            first of several copies is counted. None if frames are ambiguous.
        superframes: Frames of either capture with more payload than the largest MSS in a SYN, because offload joined
            several segments. None if no MSS is known.
        ambiguous_frames: Frames with bytes that were sent several times and arrived, if neither time stamps nor IP
            ids nor the time between the frames show which copy arrived.
        possible_copies: Received frames that may be copies and hide a loss (see `Match.possible_copy`).
        transfer_s: Time from the first frame to the last frame with payload at the receiver, in seconds; None without
            payload, or if a frame has no time.
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
    ambiguous_frames: int
    possible_copies: int
    transfer_s: float | None


def match_transfer(sender: Packets, receiver: Packets, transfer: Transfer) -> TcpFrames:
    """Match the frames of a TCP transfer in both captures.

    A connection is included if its SYN is in the sender's capture. This excludes retransmissions of an aborted
    earlier transfer, which may continue for minutes.

    Raises:
        EvidenceError: For the same reasons as `tcp_streams.cut`.
    """
    sent, received = (
        forward.where(forward.dport == transfer.port)
        for forward in (transfer.forward(sender), transfer.forward(receiver))
    )
    has_syn = np.isin(sent.sport, np.unique(sent.sport[sent.tcp_flags & SYN != 0]))
    sent = sent.where(has_syn)
    received = received.where(np.isin(received.sport, sent.sport))
    return TcpFrames(sent, received, match_payload(sent, received), _mss_bytes(sender, receiver, transfer.port))


def match_frames(sent: Packets, received: Packets) -> TcpFrames:
    """Match TCP frames of one direction in both captures. Raises the same errors as `match_transfer`."""
    return TcpFrames(sent, received, match_payload(sent, received), 0)


def count(frames: TcpFrames) -> TcpCounts:
    """Return the counts of a TCP transfer, summed over its connections."""
    sent, received, payload = frames.sent, frames.received, frames.payload
    sent_pieces, received_pieces = payload.sent, payload.received
    range_count = max(sent_pieces.range_id.max(initial=-1), received_pieces.range_id.max(initial=-1)) + 1
    times_sent, times_received = (
        np.bincount(pieces.range_id, minlength=range_count) for pieces in (sent_pieces, received_pieces)
    )
    ambiguous_count = len(np.unique(sent_pieces.frame[payload.match.ambiguous]))
    size_bytes = np.zeros(range_count, dtype=np.int64)
    size_bytes[sent_pieces.range_id], size_bytes[received_pieces.range_id] = (
        sent_pieces.size_bytes,
        received_pieces.size_bytes,
    )
    return TcpCounts(
        frames_sent=len(sent),
        frames_received=len(received),
        sent_bytes=int(sent_pieces.size_bytes.sum()),
        unique_bytes=int(size_bytes[times_sent > 0].sum()),
        received_bytes=int(sent_pieces.size_bytes[payload.match.arrived].sum()),
        lost_bytes=int(size_bytes[(times_sent > 0) & (times_received == 0)].sum()),
        duplicated_bytes=int((np.maximum(times_received - 1, 0) * size_bytes).sum()),
        retransmitted_frames=int(sent_again(frames).sum()),
        spurious_frames=None if ambiguous_count else _count_spurious(payload),
        reordered_frames=None if ambiguous_count else _count_reordered(payload),
        superframes=_count_superframes(frames),
        ambiguous_frames=ambiguous_count,
        possible_copies=len(np.unique(received_pieces.frame[payload.match.possible_copy])),
        transfer_s=span_s(received.time_ns, received.tcp_payload_bytes > 0),
    )


def _is_repeated(pieces: Pieces, originals: Pieces) -> Mask:
    """Return a mask of the pieces whose bytes are in `originals` in an earlier frame."""
    earliest = np.full(
        max(pieces.range_id.max(initial=-1), originals.range_id.max(initial=-1)) + 1, np.iinfo(np.int64).max
    )
    # If an index occurs several times, numpy stores the last value: the earliest frame, because the order is
    # reversed.
    earliest[originals.range_id[::-1]] = originals.frame[::-1]
    mask: Mask = pieces.frame > earliest[pieces.range_id]
    return mask


def sent_again(frames: TcpFrames) -> Mask:
    """Return a mask of the frames in `frames.sent` with bytes that had been sent before."""
    is_sent_again = np.zeros(len(frames.sent), dtype=np.bool_)
    is_sent_again[frames.payload.sent.frame[_is_repeated(frames.payload.sent, frames.payload.sent)]] = True
    return is_sent_again


def _count_spurious(payload: Payload) -> int:
    """Return the number of sent frames that contain only bytes of earlier frames that arrived."""
    is_needless = _is_repeated(payload.sent, payload.sent.where(payload.match.arrived))
    return len(np.unique(payload.sent.frame)) - len(np.unique(payload.sent.frame[~is_needless]))


def _count_reordered(payload: Payload) -> int:
    """Return the number of received frames that arrived after bytes that were sent later."""
    first_copies = np.flatnonzero((payload.match.sent_index != NONE) & ~payload.match.duplicates)
    is_late = first_copies[reordered(payload.match.sent_index[first_copies])]
    first_pieces = np.unique(payload.received.frame, return_index=True)[1]
    return int(np.isin(first_pieces, is_late).sum())


def _mss_bytes(sender: Packets, receiver: Packets, port: int) -> int:
    return max(
        int(packets.tcp_mss[(packets.sport == port) | (packets.dport == port)].max(initial=0))
        for packets in (sender, receiver)
    )


def _count_superframes(frames: TcpFrames) -> int | None:
    mss = frames.mss_bytes
    ends = frames.sent, frames.received
    return sum(int((packets.tcp_payload_bytes > mss).sum()) for packets in ends) if mss else None
