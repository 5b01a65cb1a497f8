"""Loss detection by time of transmission: RACK (RFC 8985), as Linux does it.

A segment is lost if one that was sent later has arrived and a round trip has passed since. So a segment that was sent
again and lost again is found within a round trip, and needs no timeout. The wire does not reorder packets, so the
reordering window never grows beyond a quarter of the shortest round trip.
"""

from collections import deque

from sim_backends.network.tcp.scoreboard import DUPLICATE_THRESHOLD, Scoreboard, SentSegment

_REORDERING_SHARE = 4
"""The reordering window is the shortest round trip divided by this (RFC 8985, 6.2, step 4)."""


class RackScoreboard(Scoreboard):
    """A scoreboard that finds losses by time."""

    def __init__(self) -> None:
        super().__init__()
        # Transmissions in the order of time, each with how often its segment had been sent then.
        self._transmissions: deque[tuple[SentSegment, int]] = deque()
        # When the most recently sent of the arrived segments was sent, and its end (RACK.xmit_ts, RACK.end_seq).
        self._latest_arrived = (-1, 0)
        self._round_trip_ns = 0
        self._shortest_ns: int | None = None

    def send(self, now_ns: int, length: int, number: int) -> SentSegment:
        """Record a new segment and the time of its transmission."""
        segment = super().send(now_ns, length, number)
        self._transmissions.append((segment, segment.times))
        return segment

    def send_again(self, now_ns: int, segment: SentSegment) -> None:
        """Record a segment that is sent again and the time of its transmission."""
        super().send_again(now_ns, segment)
        self._transmissions.append((segment, segment.times))

    def detect_losses(self, now_ns: int, *, recovering: bool) -> int | None:
        """Count as lost what was sent a round trip and a reordering window ago, before a segment that arrived."""
        limit_ns = self._round_trip_ns + self._reordering_window_ns(recovering=recovering)
        transmissions, waiting, due_ns = self._transmissions, list[tuple[SentSegment, int]](), None
        while transmissions:
            segment, times = transmissions[0]
            is_current = segment.copies and segment.times == times and segment.end > self.acknowledged
            if is_current and (segment.sent_ns, segment.end) >= self._latest_arrived:
                break
            transmissions.popleft()
            if not is_current:
                continue
            if segment.sent_ns + limit_ns <= now_ns:
                self._lose(segment)
            else:
                waiting.append((segment, times))
                due_ns = segment.sent_ns + limit_ns
        transmissions.extendleft(reversed(waiting))
        return due_ns

    def overtaken(self) -> None:
        """Return None: what was overtaken counts as lost after the reordering window."""

    def _deliver(self, now_ns: int, segment: SentSegment) -> None:
        super()._deliver(now_ns, segment)
        round_trip_ns = now_ns - segment.sent_ns
        if segment.times > 1 and self._shortest_ns is not None and round_trip_ns < self._shortest_ns:
            # It is an earlier transmission that arrived (RFC 8985, 6.2, step 2).
            return
        if segment.times == 1:
            self._shortest_ns = min(round_trip_ns, self._shortest_ns or round_trip_ns)
        self._round_trip_ns = round_trip_ns
        self._latest_arrived = max(self._latest_arrived, (segment.sent_ns, segment.end))

    def _reordering_window_ns(self, *, recovering: bool) -> int:
        """Return how much later than a round trip a segment may arrive (RFC 8985, 6.2, step 4)."""
        three_arrived = len(self._latest) == DUPLICATE_THRESHOLD and self._latest[0] >= self._dropped + self._gone
        if recovering or three_arrived:
            return 0
        return (self._shortest_ns or 0) // _REORDERING_SHARE
