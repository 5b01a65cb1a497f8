"""The byte stream to which a program's messages are written in order."""

from collections import deque
from dataclasses import dataclass


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
        self._numbers = 0
        self._unsent: deque[_Message] = deque()
        self._unread: deque[_Message] = deque()
        self.end = 1

    def write(self, packet_id: int, size_bytes: int) -> None:
        """Append a message."""
        message = _Message(packet_id, self.end, self.end + size_bytes, self._numbers)
        self._numbers += -(-size_bytes // self._segment_bytes)
        self.end = message.end
        self._unsent.append(message)
        self._unread.append(message)

    def number(self, first: int) -> int:
        """Return the number of the segment that starts with the byte `first`, which must not decrease between calls.

        A segment ends when it is full or at the end of a message. Therefore at most one segment starts in each
        segment-sized part of a message; the number of these parts before it is unique and independent of what was
        sent before.
        """
        while self._unsent[0].end <= first:
            self._unsent.popleft()
        message = self._unsent[0]
        return message.number + (first - message.first) // self._segment_bytes

    def read(self, upto: int) -> list[int]:
        """Return the packets that are complete before `upto` and were not returned before."""
        packet_ids = []
        while self._unread and self._unread[0].end <= upto:
            packet_ids.append(self._unread.popleft().packet_id)
        return packet_ids

    def unread(self) -> list[int]:
        """Return the packets that were not read."""
        return [message.packet_id for message in self._unread]
