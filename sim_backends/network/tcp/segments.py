"""Segments of TCP as they are on the wire, but for ports and checksums.

Sequence numbers are relative, as analysers print them: a SYN has number 0, the first byte of data number 1. They do
not wrap around.
"""

from dataclasses import dataclass
from typing import Final

from sim_backends.network.tcp.ranges import Range

HEADER_BYTES: Final = 20 + 20 + 12
"""IP header, TCP header, and the timestamps option with its padding (RFC 7323, appendix A)."""

MOST_SACKS: Final = 3
"""As many blocks as fit beside timestamps (RFC 2018, 3)."""

# MSS, SACK permitted, timestamps, window scale: 4 + 2 + 10 + 3 and a byte of padding, as Linux orders them.
_SYN_BYTES: Final = 20 + 20 + 20


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment.

    Attributes:
        syn: Whether it opens the connection.
        first: Sequence number of its first byte.
        length: How many bytes of data it carries.
        acknowledges: The sequence number that its sender waits for; None only in the first SYN.
        sacks: What its sender has got beyond that, the newest first.
        window_bytes: How much more its sender takes from `acknowledges` on, after scaling.
        sent_ns: The time that it was sent: the timestamp's value.
        echoes_ns: The timestamp that it echoes; None in the first SYN.
        number: Which it is of the stream's segments; for an ACK that of the segment which it answers.
        times: How often that was sent before.
    """

    syn: bool
    first: int
    length: int
    acknowledges: int | None
    sacks: tuple[Range, ...]
    window_bytes: int
    sent_ns: int
    echoes_ns: int | None
    number: int
    times: int

    @property
    def end(self) -> int:
        """The sequence number after its last byte."""
        return self.first + self.length

    @property
    def size_bytes(self) -> int:
        """Its size with the headers of TCP and IP."""
        if self.syn:
            return _SYN_BYTES
        sacks_bytes = 4 + 8 * len(self.sacks) if self.sacks else 0
        return HEADER_BYTES + sacks_bytes + self.length
