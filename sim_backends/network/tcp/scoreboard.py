"""Sent segments that are not acknowledged: they have arrived (by SACK), are lost, or are in flight (RFC 6675)."""

import heapq
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from sim_backends.network.tcp.segments import Range, Ranges

DUPLICATE_THRESHOLD: Final = 3
"""Number of later segments that must arrive before a segment is lost (RFC 5681, 3.2; RFC 6675, 2: DupThresh)."""

_COMPACT: Final = 256
"""Number of acknowledged segments that are removed from the list together."""


@dataclass(slots=True)
class SentSegment:
    """A sent segment of the stream; it is retransmitted with the same boundaries.

    Attributes:
        first: Sequence number of its first byte.
        end: Sequence number after its last byte.
        number: Its number in the stream, from which its random numbers are derived.
        sent_ns: Time of its last transmission.
        transmissions: Number of transmissions.
        copies: Number of transmissions that are assumed to be in flight.
        has_arrived: True if a SACK reports that it arrived.
        is_lost: True if it is marked as lost.
    """

    first: int
    end: int
    number: int
    sent_ns: int
    transmissions: int = 1
    copies: int = 1
    has_arrived: bool = False
    is_lost: bool = False


class Scoreboard:
    """The segments between SND.UNA and SND.NXT.

    A segment is lost once three later segments have arrived. RFC 6675 (4, IsLost) counts their bytes, which is the
    same for full segments. Linux counts segments, as this class does, and therefore detects losses among the small
    messages of robots.

    Attributes:
        next_number: The next sequence number to send (SND.NXT).
        first_unacknowledged: The first unacknowledged sequence number (SND.UNA).
        pipe_bytes: Estimate of the bytes in flight (RFC 6675, 4, SetPipe).
        delivered_bytes: Bytes that have arrived so far according to ACKs and SACKs.
        losses: Number of times so far that a segment was marked as lost.
    """

    def __init__(self) -> None:
        self.next_number = 1
        self.first_unacknowledged = 1
        self.pipe_bytes = 0
        self.delivered_bytes = 0
        self.losses = 0
        # Acknowledged segments stay at the front of the list until `_COMPACT` of them can be removed together.
        self._sent_segments: list[SentSegment] = []
        self._acked_count = 0
        self._removed_count = 0
        self._arrived_ranges = Ranges()
        # Indices, counted over the whole stream, of the last three segments that arrived by SACK.
        self._latest_sacked: list[int] = []
        # Index, counted over the whole stream, before which the segments were already examined for losses.
        self._examined = 0
        self._to_resend: deque[SentSegment] = deque()

    def __len__(self) -> int:
        return len(self._sent_segments) - self._acked_count

    def send(self, now_ns: int, length: int, number: int) -> SentSegment:
        """Record a new segment that is sent, and return it."""
        segment = SentSegment(self.next_number, self.next_number + length, number, now_ns)
        self._sent_segments.append(segment)
        self.next_number = segment.end
        self.pipe_bytes += length
        return segment

    def send_again(self, now_ns: int, segment: SentSegment) -> None:
        """Record a segment that is sent again."""
        segment.sent_ns = now_ns
        segment.transmissions += 1
        segment.copies += 1
        self.pipe_bytes += segment.end - segment.first

    def acknowledge(self, now_ns: int, ack_number: int) -> None:
        """Process an ACK of all bytes before `ack_number`."""
        self.first_unacknowledged = ack_number
        while (
            self._acked_count < len(self._sent_segments) and self._sent_segments[self._acked_count].end <= ack_number
        ):
            segment = self._sent_segments[self._acked_count]
            if not segment.has_arrived:
                self._count_delivered(now_ns, segment)
            self._remove_from_pipe(segment)
            self._acked_count += 1
        self._arrived_ranges.remove_before(ack_number)
        if self._acked_count >= _COMPACT:
            del self._sent_segments[: self._acked_count]
            self._removed_count += self._acked_count
            self._acked_count = 0

    def arrive(self, now_ns: int, sacks: Iterable[Range]) -> None:
        """Process the ranges that a SACK reports as arrived."""
        for block in sacks:
            first = max(block[0], self.first_unacknowledged)
            if first < block[1]:
                for new_range in self._arrived_ranges.add(first, block[1]):
                    self._mark_arrived(now_ns, new_range)

    def detect_losses(self, now_ns: int, *, is_recovering: bool) -> int | None:  # noqa: ARG002 (see RackScoreboard)
        """Mark a segment as lost if three later segments have overtaken it.

        Args:
            now_ns: Current time.
            is_recovering: True if a recovery is in progress.

        Returns:
            The time at which to call this method again unless an ACK arrives before; None if only an ACK can reveal a
            further loss.
        """
        if len(self._latest_sacked) == DUPLICATE_THRESHOLD:
            self._mark_overtaken_lost(self._latest_sacked[0])
        return None

    def lose_all(self) -> None:
        """Mark all segments that have not arrived as lost, as after a timeout."""
        self._to_resend.clear()
        for segment in self._sent_segments[self._acked_count :]:
            if not segment.has_arrived:
                self._mark_lost(segment)
        self._examined = self._removed_count + len(self._sent_segments)

    def next_lost(self) -> SentSegment | None:
        """Return the first lost segment that has not been retransmitted since its loss, or None."""
        lost_segments = self._to_resend
        while lost_segments and (
            lost_segments[0].has_arrived or not lost_segments[0].is_lost or lost_segments[0].copies
        ):
            lost_segments.popleft()
        return lost_segments[0] if lost_segments else None

    def next_overtaken(self) -> SentSegment | None:
        """Return the first segment that was sent once and was overtaken by fewer than three later ones, or None.

        It may be sent again when no segment is lost and there is no new data (RFC 6675, 4, NextSeg, rule 3).
        """
        last = max(self._latest_sacked, default=-1) - self._removed_count
        for segment in self._sent_segments[
            max(self._examined - self._removed_count, self._acked_count) : max(last, 0)
        ]:
            if not segment.has_arrived and segment.transmissions == 1:
                return segment
        return None

    def _mark_arrived(self, now_ns: int, block: Range) -> None:
        sent_segments = self._sent_segments
        index = bisect_left(sent_segments, block[0], lo=self._acked_count, key=lambda segment: segment.first)
        while index < len(sent_segments) and sent_segments[index].end <= block[1]:
            segment = sent_segments[index]
            self._remove_from_pipe(segment)
            segment.has_arrived = True
            self._count_delivered(now_ns, segment)
            heapq.heappush(self._latest_sacked, self._removed_count + index)
            if len(self._latest_sacked) > DUPLICATE_THRESHOLD:
                heapq.heappop(self._latest_sacked)
            index += 1

    def _count_delivered(self, now_ns: int, segment: SentSegment) -> None:  # noqa: ARG002 (see RackScoreboard)
        """Count a segment that an ACK or a SACK reports for the first time."""
        self.delivered_bytes += segment.end - segment.first

    def _mark_overtaken_lost(self, before: int) -> None:
        """Mark the segments before this index that have not arrived as lost, each once."""
        begin = max(self._examined - self._removed_count, self._acked_count)
        for segment in self._sent_segments[begin : max(before - self._removed_count, begin)]:
            if segment.copies > 1:
                # It was sent again before it was marked as lost: only the first copy is lost.
                segment.copies -= 1
                self.pipe_bytes -= segment.end - segment.first
            elif not segment.has_arrived:
                self._mark_lost(segment)
        self._examined = max(self._examined, before)

    def _mark_lost(self, segment: SentSegment) -> None:
        self._remove_from_pipe(segment)
        segment.is_lost = True
        self.losses += 1
        self._to_resend.append(segment)

    def _remove_from_pipe(self, segment: SentSegment) -> None:
        """Remove a segment from the bytes in flight."""
        self.pipe_bytes -= segment.copies * (segment.end - segment.first)
        segment.copies = 0
        segment.is_lost = False
