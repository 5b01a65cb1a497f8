"""What was sent and not acknowledged: what of it arrived by SACK, what is lost, what is under way (RFC 6675)."""

import heapq
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from sim_backends.network.tcp.ranges import Range, Ranges

DUPLICATE_THRESHOLD: Final = 3
"""So many later segments must have arrived before one counts as lost (RFC 5681, 3.2; RFC 6675, 2: DupThresh)."""

_COMPACT: Final = 256


@dataclass(slots=True)
class SentSegment:
    """A segment of the stream that was sent; it is sent again as it was.

    Attributes:
        first: Sequence number of its first byte.
        end: The one after its last.
        number: Which it is of the stream, for random draws.
        sent_ns: When it was last sent.
        times: How often it was sent.
        copies: How many of these are taken to be under way.
        arrived: Whether a SACK says that it arrived.
        lost: Whether what was sent is taken for lost.
    """

    first: int
    end: int
    number: int
    sent_ns: int
    times: int = 1
    copies: int = 1
    arrived: bool = False
    lost: bool = False


class Scoreboard:
    """The segments between SND.UNA and SND.NXT.

    A segment is lost once three later ones arrived. RFC 6675 (4, IsLost) counts their bytes, which is the same for
    full segments; Linux counts segments, as here, and so sees losses among the small messages of robots.

    Attributes:
        next: The sequence number that is sent next (SND.NXT).
        acknowledged: The first that was not acknowledged (SND.UNA).
        pipe_bytes: What is taken to be under way (RFC 6675, 4, SetPipe).
        delivered_bytes: What arrived so far, by ACK or SACK.
        losses: How many segments were counted as lost so far.
    """

    def __init__(self) -> None:
        self.next = 1
        self.acknowledged = 1
        self.pipe_bytes = 0
        self.delivered_bytes = 0
        self.losses = 0
        # Those acknowledged stay at the front of the list until some have gathered.
        self._sent: list[SentSegment] = []
        self._gone = 0
        self._dropped = 0
        self._arrived = Ranges()
        # Places, counted over the whole stream, of the last three segments that arrived by SACK.
        self._latest: list[int] = []
        self._judged = 0
        self._to_resend: deque[SentSegment] = deque()

    def __len__(self) -> int:
        return len(self._sent) - self._gone

    def send(self, now_ns: int, length: int, number: int) -> SentSegment:
        """Record a new segment that is sent, and return it."""
        segment = SentSegment(self.next, self.next + length, number, now_ns)
        self._sent.append(segment)
        self.next = segment.end
        self.pipe_bytes += length
        return segment

    def send_again(self, now_ns: int, segment: SentSegment) -> None:
        """Record a segment that is sent again."""
        segment.sent_ns = now_ns
        segment.times += 1
        segment.copies += 1
        self.pipe_bytes += segment.end - segment.first

    def acknowledge(self, now_ns: int, upto: int) -> None:
        """Take an ACK of everything before `upto`."""
        self.acknowledged = upto
        while self._gone < len(self._sent) and self._sent[self._gone].end <= upto:
            segment = self._sent[self._gone]
            if not segment.arrived:
                self._deliver(now_ns, segment)
            self._land(segment)
            self._gone += 1
        self._arrived.forget_before(upto)
        if self._gone >= _COMPACT:
            del self._sent[: self._gone]
            self._dropped += self._gone
            self._gone = 0

    def arrive(self, now_ns: int, sacks: Iterable[Range]) -> None:
        """Take what a SACK reports as arrived."""
        for block in sacks:
            first = max(block[0], self.acknowledged)
            if first < block[1]:
                for new in self._arrived.add(first, block[1]):
                    self._mark(now_ns, new)

    def detect_losses(self, now_ns: int, *, recovering: bool) -> int | None:  # noqa: ARG002 (see RackScoreboard)
        """Count as lost the segments that the arrived ones show to be lost: those that three later ones overtook.

        Args:
            now_ns: Now.
            recovering: Whether a recovery is under way.

        Returns:
            When to call this again even if no ACK arrives before; None if only an ACK can show a further loss.
        """
        if len(self._latest) == DUPLICATE_THRESHOLD:
            self._judge(self._latest[0])
        return None

    def lose_all(self) -> None:
        """Count as lost whatever has not arrived, as after a timeout."""
        self._to_resend.clear()
        for segment in self._sent[self._gone :]:
            if not segment.arrived:
                self._lose(segment)
        self._judged = self._dropped + len(self._sent)

    def lost(self) -> SentSegment | None:
        """Return the first lost segment that was not sent again since, None if there is none."""
        waiting = self._to_resend
        while waiting and (waiting[0].arrived or not waiting[0].lost or waiting[0].copies):
            waiting.popleft()
        return waiting[0] if waiting else None

    def overtaken(self) -> SentSegment | None:
        """Return the first segment that later ones overtook, though not three, and that was sent once only.

        It is what may be sent again when nothing is lost and nothing new is there (RFC 6675, 4, NextSeg, rule 3).
        """
        last = max(self._latest, default=-1) - self._dropped
        for segment in self._sent[max(self._judged - self._dropped, self._gone) : max(last, 0)]:
            if not segment.arrived and segment.times == 1:
                return segment
        return None

    def _mark(self, now_ns: int, block: Range) -> None:
        sent = self._sent
        place = bisect_left(sent, block[0], lo=self._gone, key=lambda segment: segment.first)
        while place < len(sent) and sent[place].end <= block[1]:
            segment = sent[place]
            self._land(segment)
            segment.arrived = True
            self._deliver(now_ns, segment)
            heapq.heappush(self._latest, self._dropped + place)
            if len(self._latest) > DUPLICATE_THRESHOLD:
                heapq.heappop(self._latest)
            place += 1

    def _deliver(self, now_ns: int, segment: SentSegment) -> None:  # noqa: ARG002 (see RackScoreboard)
        """Count a segment that an ACK or a SACK reports for the first time."""
        self.delivered_bytes += segment.end - segment.first

    def _judge(self, before: int) -> None:
        """Count as lost what has not arrived of the segments before this place, each once."""
        begin = max(self._judged - self._dropped, self._gone)
        for segment in self._sent[begin : max(before - self._dropped, begin)]:
            if segment.copies > 1:
                # It was sent again before it was lost: only the first copy is.
                segment.copies -= 1
                self.pipe_bytes -= segment.end - segment.first
            elif not segment.arrived:
                self._lose(segment)
        self._judged = max(self._judged, before)

    def _lose(self, segment: SentSegment) -> None:
        self._land(segment)
        segment.lost = True
        self.losses += 1
        self._to_resend.append(segment)

    def _land(self, segment: SentSegment) -> None:
        """Take a segment out of what is under way."""
        self.pipe_bytes -= segment.copies * (segment.end - segment.first)
        segment.copies = 0
        segment.lost = False
