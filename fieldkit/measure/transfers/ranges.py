"""Payload of TCP frames as ranges of a stream, cut at the same positions in two captures.

A byte is identified by its sequence number (RFC 9293, section 3.4). With segmentation offload, captured frames
contain several segments and differ between the two ends. All frames are therefore cut wherever a frame of either end
starts or ends.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Ints, Table, row_hashes
from fieldkit.measure.captures.ip import TCP
from fieldkit.measure.captures.packets import SYN, Packets

# Upper limit of the length of a stream: byte positions of different connections are this far apart.
_MAX_STREAM_BYTES: Final = 1 << 44

# The number of pieces of frames that all overlap is quadratic. In a transfer it is not: each end of a frame cuts one
# other frame and its copies.
_PIECES_PER_FRAME: Final = 16
_MIN_PIECE_LIMIT: Final = 1 << 20


@dataclass(frozen=True, eq=False)
class Pieces(Table):
    """Pieces of payload in the order of the frames and, within a frame, of the bytes.

    Attributes:
        frame: Index of the frame that contains the piece.
        range_id: Number of the byte range; pieces with the same number have the same bytes.
        size_bytes: Length of the piece.
    """

    frame: Ints
    range_id: Ints
    size_bytes: Ints


def cut(sent: Packets, received: Packets) -> tuple[Pieces, Pieces]:
    """Cut the payload of the TCP frames in two captures into comparable pieces.

    Raises:
        EvidenceError: There are implausibly many overlaps, so that the pieces would fill the memory.
    """
    frames = [np.flatnonzero(packets.protocol == TCP) for packets in (sent, received)]
    both = Packets.concatenated((sent.where(frames[0]), received.where(frames[1])))
    connection_key = row_hashes(*both.src.T, *both.dst.T, both.sport << 16 | both.dport)
    _, first, connection = np.unique(connection_key, return_index=True, return_inverse=True)
    sides = slice(0, len(frames[0])), slice(len(frames[0]), None)
    start = np.concatenate([_starts(both.where(side), connection[side], both.tcp_seq[first]) for side in sides])
    stop = start + both.tcp_payload_bytes
    edges = np.unique(np.concatenate((start, stop)))
    first = np.searchsorted(edges, start)
    count = np.searchsorted(edges, stop) - first
    if count.sum() > _MIN_PIECE_LIMIT + _PIECES_PER_FRAME * len(both):
        raise EvidenceError(f"{len(both)} TCP frames overlap in {count.sum()} pieces, too many for a transfer")
    size_bytes = np.diff(edges)
    sent_pieces, received_pieces = (
        _pieces(frame, first[side], count[side], size_bytes) for frame, side in zip(frames, sides, strict=True)
    )
    return sent_pieces, received_pieces


def _starts(packets: Packets, connection: Ints, base: Ints) -> Ints:
    """Return the position in the stream at which each TCP frame's payload starts, with unwrapped sequence numbers.

    Sequence numbers have 32 bits. The step between consecutive frames of a connection is taken as the difference with
    the smaller magnitude; the first step starts from `base`.
    """
    order = np.argsort(connection, kind="stable")
    seq, number = packets.tcp_seq[order], connection[order]
    is_first = np.diff(number, prepend=-1) != 0
    steps = np.where(is_first, seq - base[number], np.diff(seq, prepend=0))
    positions = np.append(0, np.cumsum((steps + 2**31) % 2**32 - 2**31))
    first_position = positions[np.flatnonzero(is_first)][np.cumsum(is_first) - 1]
    start: Ints = np.empty_like(seq)
    start[order] = positions[1:] - first_position + number * _MAX_STREAM_BYTES
    # SYN consumes the sequence number before the first byte of payload.
    start += packets.tcp_flags & SYN != 0
    return start


def _pieces(frame: Ints, first: Ints, count: Ints, size_bytes: Ints) -> Pieces:
    """Return the pieces of frames, each consisting of `count` byte ranges from `first` on."""
    range_id = np.arange(count.sum()) + np.repeat(first - (np.cumsum(count) - count), count)
    return Pieces(np.repeat(frame, count), range_id, size_bytes[range_id])
