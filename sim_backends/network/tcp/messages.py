"""The stream that a program's messages are written to, one after the other."""

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class _Message:
    packet_id: int
    first: int
    end: int
    number: int


class MessageStream:
    """Where in the stream each message lies.

    Args:
        segment_bytes: Data in a full segment.

    Attributes:
        end: The sequence number after the last byte that was written.
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
        """Return which segment of the stream begins with the byte `first`, which never goes back.

        A segment ends when it is full or with a message. So no two begin in the same full segment's length of one
        message, and counting these lengths gives each segment a number of its own, whatever was sent before.
        """
        while self._unsent[0].end <= first:
            self._unsent.popleft()
        message = self._unsent[0]
        return message.number + (first - message.first) // self._segment_bytes

    def read(self, upto: int) -> list[int]:
        """Return the packets whose last byte is before `upto` and that were not returned before."""
        whole = []
        while self._unread and self._unread[0].end <= upto:
            whole.append(self._unread.popleft().packet_id)
        return whole

    def unread(self) -> list[int]:
        """Return the packets that were not read."""
        return [message.packet_id for message in self._unread]
