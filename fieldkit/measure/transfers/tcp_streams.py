"""TCP streams in captures: payload as byte ranges, bytes of each connection, bytes that the receiver acknowledged.

The ranges of two captures start and end at the same positions, so that they can be compared.
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Ints, Mask, Table, row_hashes
from fieldkit.measure.captures.headers import TCP
from fieldkit.measure.captures.packets import ACK, FIN, SYN, Packets

# Upper limit of the length of a stream, and distance between the byte positions of two connections.
_MAX_STREAM_BYTES: Final = 1 << 44

# The number of pieces is quadratic if all frames overlap. In a transfer it is not, because each end of a frame
# divides only one other frame and its copies. The limit is a number per frame plus a constant.
_PIECES_PER_FRAME: Final = 16
_MIN_PIECE_LIMIT: Final = 1 << 20


@dataclass(frozen=True, eq=False)
class Pieces(Table):
    """Pieces of payload, in the order of the frames and of the bytes in a frame.

    Attributes:
        frame: Index of the frame that contains the piece.
        range_id: Number of the byte range; pieces with the same number have the same bytes.
        size_bytes: Length of the piece.
    """

    frame: Ints
    range_id: Ints
    size_bytes: Ints


def cut(sent: Packets, received: Packets) -> tuple[Pieces, Pieces]:
    """Divide the payload of the TCP frames in two captures into comparable pieces.

    Raises:
        EvidenceError: There are implausibly many overlaps, so the pieces would need too much memory.
    """
    frames = [np.flatnonzero(packets.protocol == TCP) for packets in (sent, received)]
    all_frames = Packets.concatenated((sent.where(frames[0]), received.where(frames[1])))
    connection_key = row_hashes(*all_frames.src.T, *all_frames.dst.T, all_frames.sport << 16 | all_frames.dport)
    _, first_rows, connection = np.unique(connection_key, return_index=True, return_inverse=True)
    sides = slice(0, len(frames[0])), slice(len(frames[0]), None)
    start = np.concatenate(
        [_starts(all_frames.where(side), connection[side], all_frames.tcp_seq[first_rows]) for side in sides]
    )
    stop = start + all_frames.tcp_payload_bytes
    edges = np.unique(np.concatenate((start, stop)))
    first = np.searchsorted(edges, start)
    count = np.searchsorted(edges, stop) - first
    if count.sum() > _MIN_PIECE_LIMIT + _PIECES_PER_FRAME * len(all_frames):
        raise EvidenceError(f"{len(all_frames)} TCP frames overlap in {count.sum()} pieces, too many for a transfer")
    size_bytes = np.diff(edges)
    sent_pieces, received_pieces = (
        _pieces(frame, first[side], count[side], size_bytes) for frame, side in zip(frames, sides, strict=True)
    )
    return sent_pieces, received_pieces


def _starts(packets: Packets, connection: Ints, base: Ints) -> Ints:
    """Return the position of each TCP frame's payload in its stream, with unwrapped sequence numbers.

    Sequence numbers have 32 bits, so the difference between consecutive frames of a connection is ambiguous. The
    value with the smaller magnitude is used. The first difference is relative to `base`.
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
    """Return the pieces of frames. Each frame consists of `count` byte ranges from number `first` on."""
    range_id = np.arange(count.sum()) + np.repeat(first - (np.cumsum(count) - count), count)
    return Pieces(np.repeat(frame, count), range_id, size_bytes[range_id])


LONGEST_BYTES: Final = 1 << 31
"""Limit of the length of a stream: from this length on, 32-bit sequence numbers are ambiguous."""

_CONNECTION_BITS: Final = 33
"""Number of bits of a position within a connection, including positions before its start."""


@dataclass(frozen=True, eq=False)
class ByteIntervals:
    """Half-open intervals of byte positions, from `starts` to before `stops`. Intervals may overlap."""

    starts: Ints
    stops: Ints

    @property
    def size_bytes(self) -> int:
        """Number of bytes that the intervals cover, each counted once."""
        if not len(self.starts):
            return 0
        order = np.argsort(self.starts)
        starts, max_stops = self.starts[order], np.maximum.accumulate(self.stops[order])
        new_from = np.maximum(starts[1:], max_stops[:-1])
        return int(max_stops[0] - starts[0] + np.maximum(max_stops[1:] - new_from, 0).sum())

    def bytes_not_in(self, other: "ByteIntervals") -> int:
        """Return the number of bytes that these intervals cover, but `other` does not cover."""
        union = ByteIntervals(np.concatenate((self.starts, other.starts)), np.concatenate((self.stops, other.stops)))
        return union.size_bytes - other.size_bytes


@dataclass(frozen=True, eq=False)
class Connections:
    """Connections to the port of a transfer, if their SYN is in a capture.

    Attributes:
        ports: Sender's port of each connection, ascending.
        first_seq: Sequence number of the first byte of each connection.
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
        # A SYN consumes a sequence number before its data, which it may contain with TCP Fast Open (RFC 7413).
        starts = self._positions(selected.sport, selected.tcp_seq + (selected.tcp_flags & SYN != 0))
        return ByteIntervals(starts, starts + selected.tcp_payload_bytes)

    def numbers(self, frames: Packets) -> ByteIntervals:
        """Return the positions of payload bytes and of FINs, which consume one sequence number each."""
        fin_frames = frames.where(self.includes(frames.sport) & (frames.tcp_flags & FIN != 0))
        stops = self._positions(fin_frames.sport, fin_frames.tcp_seq) + fin_frames.tcp_payload_bytes
        payload = self.payload(frames)
        return ByteIntervals(np.concatenate((payload.starts, stops)), np.concatenate((payload.stops, stops + 1)))

    def acknowledged(self, answers: Packets) -> ByteIntervals:
        """Return the positions that frames from receiver to sender acknowledge."""
        selected = answers.where(self.includes(answers.dport) & (answers.tcp_flags & ACK != 0))
        starts = self._positions(selected.dport, self.first_seq[np.searchsorted(self.ports, selected.dport)])
        return ByteIntervals(starts, np.maximum(starts, self._positions(selected.dport, selected.tcp_ack)))

    def _positions(self, ports: Ints, numbers: Ints) -> Ints:
        index = np.searchsorted(self.ports, ports)
        # Relative to the first byte; negative for earlier numbers. Each connection has a separate range of positions.
        relative = (numbers - self.first_seq[index] + LONGEST_BYTES) % 2**32 - LONGEST_BYTES
        positions: Ints = (index + 1 << _CONNECTION_BITS) + relative
        return positions
