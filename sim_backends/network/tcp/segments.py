"""TCP segments as they are on the wire, without ports and checksums.

Sequence numbers are relative, as in packet analysers: a SYN has number 0, the first data byte number 1. They do not
wrap around.
"""

from dataclasses import dataclass
from typing import Final

from sim_backends.network.tcp.ranges import Range

HEADER_BYTES: Final = 20 + 20 + 12
"""IP header, TCP header, and the timestamps option with its padding (RFC 7323, appendix A)."""

MAX_SACKS: Final = 3
"""Maximum number of SACK blocks together with timestamps (RFC 2018, 3)."""

# MSS, SACK permitted, timestamps, window scale: 4 + 2 + 10 + 3 bytes and a byte of padding, in Linux's order.
_SYN_BYTES: Final = 20 + 20 + 20


@dataclass(frozen=True, slots=True)
class Segment:
    """A TCP segment.

    Attributes:
        syn: True if it opens the connection.
        first: Sequence number of its first byte.
        length: Number of data bytes.
        acknowledges: Acknowledgement number; None only in the first SYN.
        sacks: Ranges beyond it that its sender has received, most recent first.
        window_bytes: Receive window of its sender, after scaling.
        sent_ns: Transmission time: the timestamp's value (TSval).
        echoes_ns: The echoed timestamp (TSecr); None in the first SYN.
        number: Its number in the stream; for an ACK the number of the acknowledged segment.
        times: Number of earlier transmissions of that segment.
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
