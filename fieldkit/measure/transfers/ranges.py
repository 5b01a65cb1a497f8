"""Payload of TCP frames as ranges of a stream, cut so that those of two captures compare.

A byte is told by its sequence number (RFC 9293, section 3.4). With segmentation offload a capture sees frames of many
segments, and each end other ones: so all frames are cut wherever one of either end starts or stops.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Ints, Table, mixed
from fieldkit.measure.captures.ip import TCP
from fieldkit.measure.captures.packets import SYN, Packets

# A stream is shorter than this: each connection has its own stretch of the numbers of bytes.
_LONGEST_BYTES: Final = 1 << 44

# Frames that all overlap make as many pieces as their number squared. Those of a transfer do not: each end of a frame
# cuts one other frame, or as many as there are copies of that.
_PIECES_PER_FRAME: Final = 16
_FEW_PIECES: Final = 1 << 20


@dataclass(frozen=True, eq=False)
class Pieces(Table):
    """Pieces of payload in the order of the frames, and of the bytes in each.

    Attributes:
        frame: Index of the frame that carries it.
        stretch: Number of the stretch of a stream that it is; the pieces of one stretch have the same bytes.
        size_bytes: Its length.
    """

    frame: Ints
    stretch: Ints
    size_bytes: Ints


def cut(sent: Packets, received: Packets) -> tuple[Pieces, Pieces]:
    """Return the payload of the TCP frames among the packets of two captures in comparable pieces.

    Raises:
        EvidenceError: Frames overlap as those of no transfer do: their pieces would fill the memory.
    """
    frames = [np.flatnonzero(packets.protocol == TCP) for packets in (sent, received)]
    both = Packets.joined((sent.where(frames[0]), received.where(frames[1])))
    connection_key = mixed(*both.src.T, *both.dst.T, both.sport << 16 | both.dport)
    _, first, connection = np.unique(connection_key, return_index=True, return_inverse=True)
    sides = slice(0, len(frames[0])), slice(len(frames[0]), None)
    start = np.concatenate([_starts(both.where(side), connection[side], both.tcp_seq[first]) for side in sides])
    stop = start + both.tcp_payload_bytes
    edges = np.unique(np.concatenate((start, stop)))
    first = np.searchsorted(edges, start)
    count = np.searchsorted(edges, stop) - first
    if count.sum() > _FEW_PIECES + _PIECES_PER_FRAME * len(both):
        raise EvidenceError(f"{len(both)} TCP frames overlap in {count.sum()} pieces, as those of no transfer do")
    size_bytes = np.diff(edges)
    left, came = (
        _pieces(frame, first[side], count[side], size_bytes) for frame, side in zip(frames, sides, strict=True)
    )
    return left, came


def _starts(packets: Packets, connection: Ints, base: Ints) -> Ints:
    """Return where the payload of TCP frames starts, as if no sequence number ever wrapped.

    A sequence number has 32 bits: each step from one frame of a connection to the next is taken as the shorter way
    round, the first one from its `base`.
    """
    order = np.argsort(connection, kind="stable")
    seq, number = packets.tcp_seq[order], connection[order]
    begins = np.diff(number, prepend=-1) != 0
    steps = np.where(begins, seq - base[number], np.diff(seq, prepend=0))
    reached = np.append(0, np.cumsum((steps + 2**31) % 2**32 - 2**31))
    before = reached[np.flatnonzero(begins)][np.cumsum(begins) - 1]
    start: Ints = np.empty_like(seq)
    start[order] = reached[1:] - before + number * _LONGEST_BYTES
    # SYN takes the sequence number before the first byte of payload.
    start += packets.tcp_flags & SYN != 0
    return start


def _pieces(frame: Ints, first: Ints, count: Ints, size_bytes: Ints) -> Pieces:
    """Return the pieces of frames, each of `count` stretches from `first` on."""
    stretch = np.arange(count.sum()) + np.repeat(first - (np.cumsum(count) - count), count)
    return Pieces(np.repeat(frame, count), stretch, size_bytes[stretch])
