"""The byte stream of a connection: the messages written to it, its segments, and ranges of its sequence numbers.

Segments have the same fields as on the wire, except ports and checksums. Sequence numbers are relative, as in packet
analysers: a SYN has number 0, the first data byte number 1. They do not wrap around.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

Range = tuple[int, int]
"""The first number, and the number after the last."""


class Ranges:
    """A set of numbers, stored as ranges that are neither overlapping nor adjacent."""

    def __init__(self) -> None:
        self._firsts: list[int] = []
        self._ends: list[int] = []

    def __iter__(self) -> Iterator[Range]:
        return zip(self._firsts, self._ends, strict=True)

    def __len__(self) -> int:
        return len(self._firsts)

    def add(self, first: int, end: int) -> list[Range]:
        """Add the numbers from `first` to `end`, exclusive; return the ranges that are new, in order."""
        begin = bisect_left(self._ends, first)
        after = bisect_right(self._firsts, end)
        new_ranges = []
        position = first
        for existing_first, existing_end in zip(self._firsts[begin:after], self._ends[begin:after], strict=True):
            if position < existing_first:
                new_ranges.append((position, existing_first))
            position = max(position, existing_end)
        if position < end:
            new_ranges.append((position, end))
        if begin < after:
            first = min(first, self._firsts[begin])
            end = max(end, self._ends[after - 1])
        self._firsts[begin:after] = [first]
        self._ends[begin:after] = [end]
        return new_ranges

    def containing(self, number: int) -> Range | None:
        """Return the range that contains `number`, or None."""
        index = bisect_right(self._firsts, number) - 1
        if index < 0 or self._ends[index] <= number:
            return None
        return self._firsts[index], self._ends[index]

    def remove_before(self, number: int) -> None:
        """Remove all ranges that end at or before `number`."""
        count = bisect_right(self._ends, number)
        del self._firsts[:count]
        del self._ends[:count]


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
        acknowledges: Acknowledgement number; None in a SYN of the end that opens the connection.
        sacks: Ranges beyond that number that the sender of the segment has received, most recent first.
        window_bytes: Receive window of its sender, after scaling.
        sent_ns: Transmission time: the timestamp's value (TSval).
        echoes_ns: The echoed timestamp (TSecr); None if its sender has received no segment yet.
        number: Its number in the stream; for an ACK the number of the acknowledged segment.
        earlier_transmissions: Number of earlier transmissions of that segment.
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
    earlier_transmissions: int

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


@dataclass(frozen=True, slots=True)
class _Message:
    packet_id: int
    first: int
    end: int
    number: int


class MessageStream:
    """The positions of messages in the stream.

    Args:
        segment_bytes: Data bytes in a full segment.

    Attributes:
        end: The sequence number after the last written byte.
    """

    def __init__(self, segment_bytes: int) -> None:
        self._segment_bytes = segment_bytes
        self._next_segment_number = 0
        self._unsent: deque[_Message] = deque()
        self._unread: deque[_Message] = deque()
        self.end = 1

    def write(self, packet_id: int, size_bytes: int) -> None:
        """Append a message."""
        message = _Message(packet_id, self.end, self.end + size_bytes, self._next_segment_number)
        self._next_segment_number += -(-size_bytes // self._segment_bytes)
        self.end = message.end
        self._unsent.append(message)
        self._unread.append(message)

    def number(self, first: int) -> int:
        """Return the number of the segment that starts with the byte `first`, which must not decrease between calls.

        A message is divided into parts of the size of a segment. A segment ends when it is full or at the end of a
        message, so at most one segment starts in each part. Its number is the count of all earlier parts, which is
        unique and does not depend on the sizes of earlier segments.
        """
        while self._unsent[0].end <= first:
            self._unsent.popleft()
        message = self._unsent[0]
        return message.number + (first - message.first) // self._segment_bytes

    def read(self, end: int) -> list[int]:
        """Return the ids of the messages that end at or before `end` and have not been returned before."""
        packet_ids = []
        while self._unread and self._unread[0].end <= end:
            packet_ids.append(self._unread.popleft().packet_id)
        return packet_ids

    def unread(self) -> list[int]:
        """Return the ids of the messages that have not been read."""
        return [message.packet_id for message in self._unread]
