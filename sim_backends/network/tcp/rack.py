"""Time-based loss detection: RACK (RFC 8985), as in Linux.

A segment is lost if a segment that was sent later has arrived and a round trip has passed since. The loss of a
retransmission is therefore also detected within a round trip, without a timeout. The wire does not reorder packets,
so the reordering window is never increased above a quarter of the minimum round trip.
"""

from collections import deque

from sim_backends.network.tcp.scoreboard import DUPLICATE_THRESHOLD, Scoreboard, SentSegment

_REORDERING_SHARE = 4
"""The reordering window is the minimum round trip divided by this (RFC 8985, 6.2, step 4)."""


class RackScoreboard(Scoreboard):
    """A scoreboard that detects losses by time."""

    def __init__(self) -> None:
        super().__init__()
        # Transmissions in order of time, each with the number of transmissions of its segment up to then.
        self._transmissions: deque[tuple[SentSegment, int]] = deque()
        # Transmission time and end of the most recently sent segment that arrived (RACK.xmit_ts, RACK.end_seq).
        self._latest_delivered = (-1, 0)
        self._round_trip_ns = 0
        self._min_round_trip_ns: int | None = None

    def send(self, now_ns: int, length: int, number: int) -> SentSegment:
        """Record a new segment and the time of its transmission."""
        segment = super().send(now_ns, length, number)
        self._transmissions.append((segment, segment.times))
        return segment

    def send_again(self, now_ns: int, segment: SentSegment) -> None:
        """Record a retransmitted segment and the time of its transmission."""
        super().send_again(now_ns, segment)
        self._transmissions.append((segment, segment.times))

    def detect_losses(self, now_ns: int, *, recovering: bool) -> int | None:
        """Mark segments as lost that were sent before one that arrived, and more than the time limit ago.

        The limit is a round trip and the reordering window.
        """
        limit_ns = self._round_trip_ns + self._reordering_window_ns(recovering=recovering)
        transmissions, undecided, due_ns = self._transmissions, list[tuple[SentSegment, int]](), None
        while transmissions:
            segment, times = transmissions[0]
            is_current = segment.copies and segment.times == times and segment.end > self.acknowledged
            if is_current and (segment.sent_ns, segment.end) >= self._latest_delivered:
                break
            transmissions.popleft()
            if not is_current:
                continue
            if segment.sent_ns + limit_ns <= now_ns:
                self._mark_lost(segment)
            else:
                undecided.append((segment, times))
                due_ns = segment.sent_ns + limit_ns
        transmissions.extendleft(reversed(undecided))
        return due_ns

    def next_overtaken(self) -> None:
        """Return None: overtaken segments are marked as lost after the reordering window."""

    def _count_delivered(self, now_ns: int, segment: SentSegment) -> None:
        super()._count_delivered(now_ns, segment)
        round_trip_ns = now_ns - segment.sent_ns
        if segment.times > 1 and self._min_round_trip_ns is not None and round_trip_ns < self._min_round_trip_ns:
            # It was an earlier transmission that arrived (RFC 8985, 6.2, step 2).
            return
        if segment.times == 1:
            self._min_round_trip_ns = min(round_trip_ns, self._min_round_trip_ns or round_trip_ns)
        self._round_trip_ns = round_trip_ns
        self._latest_delivered = max(self._latest_delivered, (segment.sent_ns, segment.end))

    def _reordering_window_ns(self, *, recovering: bool) -> int:
        """Return the tolerated delay of a segment beyond a round trip (RFC 8985, 6.2, step 4)."""
        threshold_reached = (
            len(self._latest_sacked) == DUPLICATE_THRESHOLD
            and self._latest_sacked[0] >= self._removed_count + self._acked_count
        )
        if recovering or threshold_reached:
            return 0
        return (self._min_round_trip_ns or 0) // _REORDERING_SHARE
