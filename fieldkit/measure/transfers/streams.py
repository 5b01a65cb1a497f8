"""Bytes of TCP connections in a capture, and those that their receiver acknowledged.

The bytes of all connections are positions on one line, on which each connection has its own interval that starts
after the sequence number of its SYN. Captures and acknowledgments can therefore be compared (RFC 9293, section 3.4).
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Mask
from fieldkit.measure.captures.packets import ACK, FIN, SYN, Packets

LONGEST_BYTES: Final = 1 << 31
"""For streams of this length or more, 32-bit sequence numbers are ambiguous."""

_CONNECTION_BITS: Final = 33
"""Number of bits for a position within a connection's interval, including positions before its start."""


@dataclass(frozen=True, eq=False)
class Covered:
    """Intervals of positions from `starts` up to and excluding `stops`; they may overlap."""

    starts: Ints
    stops: Ints

    @property
    def size_bytes(self) -> int:
        """Number of bytes that they cover, each counted once."""
        if not len(self.starts):
            return 0
        order = np.argsort(self.starts)
        starts, reached = self.starts[order], np.maximum.accumulate(self.stops[order])
        uncovered_from = np.maximum(starts[1:], reached[:-1])
        return int(reached[0] - starts[0] + np.maximum(reached[1:] - uncovered_from, 0).sum())

    def bytes_not_in(self, other: "Covered") -> int:
        """Return the number of bytes that these intervals cover and `other` does not."""
        both = Covered(np.concatenate((self.starts, other.starts)), np.concatenate((self.stops, other.stops)))
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

    def payload(self, frames: Packets) -> Covered:
        """Return the payload bytes in frames from sender to receiver."""
        selected = frames.where(self.includes(frames.sport) & (frames.tcp_payload_bytes > 0))
        # SYN consumes a sequence number before the data that TCP Fast Open lets it carry (RFC 7413).
        starts = self._places(selected.sport, selected.tcp_seq + (selected.tcp_flags & SYN != 0))
        return Covered(starts, starts + selected.tcp_payload_bytes)

    def numbers(self, frames: Packets) -> Covered:
        """Return the sequence numbers of bytes and of FINs; a FIN is acknowledged like one byte."""
        ends = frames.where(self.includes(frames.sport) & (frames.tcp_flags & FIN != 0))
        stops = self._places(ends.sport, ends.tcp_seq) + ends.tcp_payload_bytes
        carried = self.payload(frames)
        return Covered(np.concatenate((carried.starts, stops)), np.concatenate((carried.stops, stops + 1)))

    def acknowledged(self, answers: Packets) -> Covered:
        """Return the sequence numbers that frames from receiver to sender acknowledge."""
        selected = answers.where(self.includes(answers.dport) & (answers.tcp_flags & ACK != 0))
        starts = self._places(selected.dport, self.first_seq[np.searchsorted(self.ports, selected.dport)])
        return Covered(starts, np.maximum(starts, self._places(selected.dport, selected.tcp_ack)))

    def _places(self, ports: Ints, numbers: Ints) -> Ints:
        index = np.searchsorted(self.ports, ports)
        relative = (numbers - self.first_seq[index] + LONGEST_BYTES) % 2**32 - LONGEST_BYTES
        places: Ints = (index + 1 << _CONNECTION_BITS) + relative
        return places
