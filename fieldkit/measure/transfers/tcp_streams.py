"""TCP streams in captures: payload as ranges, bytes of each connection, and bytes that its receiver acknowledged.

Ranges are cut at the same positions in two captures.
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Ints, Mask, Table, row_hashes
from fieldkit.measure.captures.headers import TCP
from fieldkit.measure.captures.packets import ACK, FIN, SYN, Packets

# Upper limit of the length of a stream: byte positions of different connections are this far apart.
_MAX_STREAM_BYTES: Final = 1 << 44

# The number of pieces is quadratic if all frames overlap. It is not quadratic in a transfer, because each end of a
# frame cuts only one other frame and its copies.
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


LONGEST_BYTES: Final = 1 << 31
"""For streams of this length or more, 32-bit sequence numbers are ambiguous."""

_CONNECTION_BITS: Final = 33
"""Number of bits for a position within a connection's interval, including positions before its start."""


@dataclass(frozen=True, eq=False)
class ByteIntervals:
    """Intervals of byte positions from `starts` up to and excluding `stops`; they may overlap."""

    starts: Ints
    stops: Ints

    @property
    def size_bytes(self) -> int:
        """Number of bytes that the intervals cover, each counted once."""
        if not len(self.starts):
            return 0
        order = np.argsort(self.starts)
        starts, reached = self.starts[order], np.maximum.accumulate(self.stops[order])
        uncovered_from = np.maximum(starts[1:], reached[:-1])
        return int(reached[0] - starts[0] + np.maximum(reached[1:] - uncovered_from, 0).sum())

    def bytes_not_in(self, other: "ByteIntervals") -> int:
        """Return the number of bytes that these intervals cover and `other` does not."""
        both = ByteIntervals(np.concatenate((self.starts, other.starts)), np.concatenate((self.stops, other.stops)))
        return both.size_bytes - other.size_bytes


@dataclass(frozen=True, eq=False)
class Connections:
    """Connections to a transfer's port whose SYN is in a capture.

    Attributes:
        ports: Sender's port of each connection, ascending.
        first_seq: Sequence number of its first byte.
    """

    ports: Ints
    first_seq: Ints

    @classmethod
    def from_syn(cls, frames: Packets) -> Self:
        """Return the connections whose SYN is among frames from sender to receiver."""
        syn = frames.where(frames.tcp_flags & SYN != 0)
        ports, first = np.unique(syn.sport, return_index=True)
        return cls(ports, syn.tcp_seq[first] + 1)

    def includes(self, ports: Ints) -> Mask:
        """Return a mask of the ports that belong to one of these connections."""
        return np.isin(ports, self.ports)

    def payload(self, frames: Packets) -> ByteIntervals:
        """Return the payload bytes in frames from sender to receiver."""
        selected = frames.where(self.includes(frames.sport) & (frames.tcp_payload_bytes > 0))
        # SYN consumes a sequence number before the data that TCP Fast Open lets it carry (RFC 7413).
        starts = self._positions(selected.sport, selected.tcp_seq + (selected.tcp_flags & SYN != 0))
        return ByteIntervals(starts, starts + selected.tcp_payload_bytes)

    def numbers(self, frames: Packets) -> ByteIntervals:
        """Return the sequence numbers of bytes and of FINs; a FIN is acknowledged like one byte."""
        ends = frames.where(self.includes(frames.sport) & (frames.tcp_flags & FIN != 0))
        stops = self._positions(ends.sport, ends.tcp_seq) + ends.tcp_payload_bytes
        carried = self.payload(frames)
        return ByteIntervals(np.concatenate((carried.starts, stops)), np.concatenate((carried.stops, stops + 1)))

    def acknowledged(self, answers: Packets) -> ByteIntervals:
        """Return the sequence numbers that frames from receiver to sender acknowledge."""
        selected = answers.where(self.includes(answers.dport) & (answers.tcp_flags & ACK != 0))
        starts = self._positions(selected.dport, self.first_seq[np.searchsorted(self.ports, selected.dport)])
        return ByteIntervals(starts, np.maximum(starts, self._positions(selected.dport, selected.tcp_ack)))

    def _positions(self, ports: Ints, numbers: Ints) -> Ints:
        index = np.searchsorted(self.ports, ports)
        relative = (numbers - self.first_seq[index] + LONGEST_BYTES) % 2**32 - LONGEST_BYTES
        positions: Ints = (index + 1 << _CONNECTION_BITS) + relative
        return positions
