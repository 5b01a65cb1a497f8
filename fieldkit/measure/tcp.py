"""Loss of a TCP transfer, counted by sequence ranges.

A byte is told by its sequence number (RFC 9293, section 3.4), so neither segmentation offload, which lets a capture
see frames of many segments, nor reordering, duplicates, retransmissions or partial overlaps change what is counted.
"""

from dataclasses import dataclass

import numpy as np

from fieldkit.measure.packets import SYN, Ints, Packets
from fieldkit.measure.transfer import Transfer, span_s


@dataclass(frozen=True)
class TcpCounts:
    """What left the sender, and what of it reached the receiver's interface.

    Attributes:
        frames_sent: Frames captured at the sender, those without payload too.
        frames_received: Frames captured at the receiver; offload may make them more or fewer.
        sent_bytes: Payload bytes sent, retransmissions included.
        unique_bytes: Payload bytes sent, each sequence number once.
        received_bytes: Payload bytes received, each sequence number at most as often as it was sent.
        lost_bytes: Of the unique bytes, the ones that never reached the receiver.
        retransmitted_frames: Frames whose range had been sent before, wholly or in part.
        transfer_s: First frame to last payload frame at the receiver, in seconds; None without payload.
    """

    frames_sent: int
    frames_received: int
    sent_bytes: int
    unique_bytes: int
    received_bytes: int
    lost_bytes: int
    retransmitted_frames: int
    transfer_s: float | None


@dataclass(frozen=True, eq=False)
class _Ranges:
    """Half-open ranges of payload, in bytes from the connection's first sequence number."""

    start: Ints
    stop: Ints


def count(sender: Packets, receiver: Packets, transfer: Transfer) -> TcpCounts:
    """Return the counts of a TCP transfer, given the packets of both captures; connections are summed.

    A connection counts if its SYN left the sender while it captured: what the kernel still repeats of an earlier
    transfer, for minutes where that one broke off, is not this one's.
    """
    sent, received = (
        forward.where(forward.dport == transfer.port)
        for forward in (transfer.forward(sender), transfer.forward(receiver))
    )
    begun = np.unique(sent.sport[sent.tcp_flags & SYN != 0])
    sent, received = (packets.where(np.isin(packets.sport, begun)) for packets in (sent, received))
    sums = np.zeros(5, dtype=np.int64)
    for sport in begun:
        sums += _connection(sent.where(sent.sport == sport), received.where(received.sport == sport))
    sent_bytes, unique_bytes, received_bytes, lost_bytes, retransmitted_frames = sums.tolist()
    return TcpCounts(
        frames_sent=len(sent),
        frames_received=len(received),
        sent_bytes=sent_bytes,
        unique_bytes=unique_bytes,
        received_bytes=received_bytes,
        lost_bytes=lost_bytes,
        retransmitted_frames=retransmitted_frames,
        transfer_s=span_s(received.time_ns, received.tcp_payload_bytes > 0),
    )


def _connection(sent: Packets, received: Packets) -> tuple[int, int, int, int, int]:
    """Return sent, unique, received and lost bytes and retransmitted frames of one connection."""
    base = int(sent.tcp_seq[0])
    left, came = _ranges(sent, base), _ranges(received, base)
    edges = np.unique(np.concatenate((left.start, left.stop, came.start, came.stop)))
    width = np.diff(edges)
    times_sent, times_received = _depth(left, edges), _depth(came, edges)
    return (
        int((times_sent * width).sum()),
        int(width[times_sent > 0].sum()),
        int((np.minimum(times_sent, times_received) * width).sum()),
        int(width[(times_sent > 0) & (times_received == 0)].sum()),
        _repeated(left, edges),
    )


def _ranges(packets: Packets, base: int) -> _Ranges:
    """Return the payload ranges of frames in the order of capture.

    A sequence number has 32 bits: each step from one frame to the next is taken as the shorter way round.
    """
    steps = np.diff(packets.tcp_seq, prepend=base)
    position = np.cumsum((steps + 2**31) % 2**32 - 2**31)
    # SYN takes the sequence number before the first byte of payload.
    start = position + (packets.tcp_flags & SYN != 0)
    carries = packets.tcp_payload_bytes > 0
    return _Ranges(start[carries], (start + packets.tcp_payload_bytes)[carries])


def _depth(ranges: _Ranges, edges: Ints) -> Ints:
    """Return how many of `ranges` cover each stretch between one edge and the next."""
    change = np.zeros(len(edges), dtype=np.int64)
    np.add.at(change, np.searchsorted(edges, ranges.start), 1)
    np.subtract.at(change, np.searchsorted(edges, ranges.stop), 1)
    return np.cumsum(change)[:-1]


def _repeated(ranges: _Ranges, edges: Ints) -> int:
    """Return how many of `ranges` share a byte with an earlier one."""
    covered = np.zeros(len(edges), dtype=np.bool_)
    repeated = 0
    spans = zip(np.searchsorted(edges, ranges.start), np.searchsorted(edges, ranges.stop), strict=True)
    for start, stop in spans:
        repeated += bool(covered[start:stop].any())
        covered[start:stop] = True
    return repeated
