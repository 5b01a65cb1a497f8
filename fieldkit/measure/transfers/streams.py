"""Bytes of TCP connections that a capture holds, beside those that their receiver acknowledged.

Each connection has a stretch of one line of bytes, from the sequence number after that of its SYN on; so what two
captures and the acknowledgments say compares (RFC 9293, section 3.4).
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Mask
from fieldkit.measure.captures.packets import ACK, FIN, SYN, Packets

LONGEST_BYTES: Final = 1 << 31
"""Of a stream as long as this nobody knows how often its sequence numbers, of 32 bits, went round."""

_STRETCH: Final = 33
"""Bits of a place within the stretch of a connection, which also has room for numbers before its beginning."""


@dataclass(frozen=True, eq=False)
class Covered:
    """Stretches of the line of bytes, which may overlap: from `starts`, up to and without `stops`."""

    starts: Ints
    stops: Ints

    @property
    def size_bytes(self) -> int:
        """How many bytes they cover, each once."""
        if not len(self.starts):
            return 0
        order = np.argsort(self.starts)
        starts, reached = self.starts[order], np.maximum.accumulate(self.stops[order])
        new = np.maximum(starts[1:], reached[:-1])
        return int(reached[0] - starts[0] + np.maximum(reached[1:] - new, 0).sum())

    def beyond(self, other: "Covered") -> int:
        """Return how many bytes of these `other` does not cover."""
        both = Covered(np.concatenate((self.starts, other.starts)), np.concatenate((self.stops, other.stops)))
        return both.size_bytes - other.size_bytes


@dataclass(frozen=True, eq=False)
class Connections:
    """The connections to a transfer's port whose SYN a capture holds.

    Attributes:
        ports: Port of the sender's end of each, in ascending order.
        begins: Sequence number of its first byte.
    """

    ports: Ints
    begins: Ints

    @classmethod
    def begun(cls, frames: Packets) -> Self:
        """Return the connections that began among frames from sender to receiver."""
        syn = frames.where(frames.tcp_flags & SYN != 0)
        ports, first = np.unique(syn.sport, return_index=True)
        return cls(ports, syn.tcp_seq[first] + 1)

    def have(self, ports: Ints) -> Mask:
        """Return which ports are those of one of these connections."""
        return np.isin(ports, self.ports)

    def payload(self, frames: Packets) -> Covered:
        """Return which bytes frames from sender to receiver carry."""
        own = frames.where(self.have(frames.sport) & (frames.tcp_payload_bytes > 0))
        # A SYN takes a number of its own, before the bytes that TCP Fast Open lets it carry (RFC 7413).
        starts = self._places(own.sport, own.tcp_seq + (own.tcp_flags & SYN != 0))
        return Covered(starts, starts + own.tcp_payload_bytes)

    def numbers(self, frames: Packets) -> Covered:
        """Return the sequence numbers of bytes and of ends (FIN), which are acknowledged as one byte more."""
        ends = frames.where(self.have(frames.sport) & (frames.tcp_flags & FIN != 0))
        stops = self._places(ends.sport, ends.tcp_seq) + ends.tcp_payload_bytes
        carried = self.payload(frames)
        return Covered(np.concatenate((carried.starts, stops)), np.concatenate((carried.stops, stops + 1)))

    def acknowledged(self, answers: Packets) -> Covered:
        """Return the sequence numbers that frames from receiver to sender acknowledge."""
        own = answers.where(self.have(answers.dport) & (answers.tcp_flags & ACK != 0))
        starts = self._places(own.dport, self.begins[np.searchsorted(self.ports, own.dport)])
        return Covered(starts, np.maximum(starts, self._places(own.dport, own.tcp_ack)))

    def _places(self, ports: Ints, numbers: Ints) -> Ints:
        which = np.searchsorted(self.ports, ports)
        since = (numbers - self.begins[which] + LONGEST_BYTES) % 2**32 - LONGEST_BYTES
        places: Ints = (which + 1 << _STRETCH) + since
        return places
