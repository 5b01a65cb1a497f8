"""Loss detection and recovery: retransmission timeout (RFC 6298), RACK (RFC 8985), rate reduction (RFC 6937).

Time-based loss detection, RACK, works as in Linux: a segment is lost if a segment that was sent later has arrived,
and more than a round trip and the reordering window have passed since the segment was sent. The loss of a
retransmission is therefore also detected without a timeout. The wire does not reorder packets, so the reordering
window is never increased above a quarter of the minimum round trip.

Proportional rate reduction gives the bytes that may be sent in a recovery, as in Linux. Times are whole nanoseconds.
"""

from collections import deque

from sim_backends.network.tcp.scoreboard import DUPLICATE_THRESHOLD, Scoreboard, SentSegment
from sim_backends.network.tcp.tcp_options import TcpOptions


class RoundTrips:
    """Estimates the round trip from samples, and the timeout from the estimate.

    Args:
        options: Bounds of the timeout.

    Attributes:
        smoothed_ns: SRTT; None before the first sample.
        variation_ns: RTTVAR.
        timeout_ns: RTO.
    """

    def __init__(self, options: TcpOptions) -> None:
        self._options = options
        self.smoothed_ns: int | None = None
        self.variation_ns = 0
        self.timeout_ns = options.initial_timeout_ns

    def sample(self, round_trip_ns: int) -> None:
        """Record a measured round trip; this also cancels the exponential backoff of the timeout."""
        if self.smoothed_ns is None:
            # RFC 6298, 2.2
            self.smoothed_ns = round_trip_ns
            self.variation_ns = round_trip_ns // 2
        else:
            # RFC 6298, 2.3, with alpha 1/8 and beta 1/4
            self.variation_ns = (3 * self.variation_ns + abs(self.smoothed_ns - round_trip_ns)) // 4
            self.smoothed_ns = (7 * self.smoothed_ns + round_trip_ns) // 8
        options = self._options
        timeout_ns = self.smoothed_ns + max(options.clock_granularity_ns, 4 * self.variation_ns)
        self.timeout_ns = min(max(timeout_ns, options.min_timeout_ns), options.max_timeout_ns)

    def back_off(self) -> None:
        """Double the timeout (RFC 6298, 5.5)."""
        self.timeout_ns = min(2 * self.timeout_ns, self._options.max_timeout_ns)


_REORDERING_DIVISOR = 4
"""The reordering window is the minimum round trip divided by this number (RFC 8985, 6.2, step 4)."""


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
        self._transmissions.append((segment, segment.transmissions))
        return segment

    def send_again(self, now_ns: int, segment: SentSegment) -> None:
        """Record a retransmitted segment and the time of its transmission."""
        super().send_again(now_ns, segment)
        self._transmissions.append((segment, segment.transmissions))

    def detect_losses(self, now_ns: int, *, is_recovering: bool) -> int | None:
        """Mark each segment as lost that was sent before an arrived segment and longer ago than a limit.

        The limit is the sum of a round trip and the reordering window.

        Returns:
            The time at which all other segments that were sent before an arrived segment reach the limit; None if
            there are none.
        """
        limit_ns = self._round_trip_ns + self._reordering_window_ns(is_recovering=is_recovering)
        transmissions, undecided, due_ns = self._transmissions, list[tuple[SentSegment, int]](), None
        while transmissions:
            segment, transmission_count = transmissions[0]
            # False if the segment has arrived, is marked as lost, or was sent again later.
            is_current = (
                segment.copies
                and segment.transmissions == transmission_count
                and segment.end > self.first_unacknowledged
            )
            if is_current and (segment.sent_ns, segment.end) >= self._latest_delivered:
                break
            transmissions.popleft()
            if not is_current:
                continue
            if segment.sent_ns + limit_ns <= now_ns:
                self._mark_lost(segment)
            else:
                undecided.append((segment, transmission_count))
                due_ns = segment.sent_ns + limit_ns
        transmissions.extendleft(reversed(undecided))
        return due_ns

    def next_overtaken(self) -> None:
        """Return None: overtaken segments are marked as lost after the reordering window."""

    def _count_delivered(self, now_ns: int, segment: SentSegment) -> None:
        super()._count_delivered(now_ns, segment)
        round_trip_ns = now_ns - segment.sent_ns
        if (
            segment.transmissions > 1
            and self._min_round_trip_ns is not None
            and round_trip_ns < self._min_round_trip_ns
        ):
            # An earlier transmission has arrived (RFC 8985, 6.2, step 2).
            return
        if segment.transmissions == 1:
            self._min_round_trip_ns = min(round_trip_ns, self._min_round_trip_ns or round_trip_ns)
        self._round_trip_ns = round_trip_ns
        self._latest_delivered = max(self._latest_delivered, (segment.sent_ns, segment.end))

    def _reordering_window_ns(self, *, is_recovering: bool) -> int:
        """Return the tolerated delay of a segment beyond a round trip (RFC 8985, 6.2, step 4)."""
        # Three segments after the first unacknowledged one have arrived by SACK.
        threshold_reached = (
            len(self._latest_sacked) == DUPLICATE_THRESHOLD
            and self._latest_sacked[0] >= self._removed_count + self._acked_count
        )
        if is_recovering or threshold_reached:
            return 0
        return (self._min_round_trip_ns or 0) // _REORDERING_DIVISOR


class ProportionalReduction:
    """Reduces the bytes in flight to the threshold over a round trip, never faster than data arrives.

    RFC 6675 alone would send a burst of the size of the detected loss into a queue that has just overflowed.

    Args:
        threshold_bytes: Bytes in flight at the end of the recovery.
        flight_bytes: Bytes sent and not acknowledged at the start of the recovery (RecoverFS).
        segment_bytes: Data bytes in a full segment.
    """

    def __init__(self, threshold_bytes: int, flight_bytes: int, segment_bytes: int) -> None:
        self._threshold_bytes = threshold_bytes
        self._flight_bytes = flight_bytes
        self._segment_bytes = segment_bytes
        self._delivered_bytes = 0
        self._sent_bytes = 0

    def window_bytes(self, pipe_bytes: int, delivered_bytes: int, *, is_safe: bool) -> int:
        """Return the window after an ACK.

        Args:
            pipe_bytes: Estimate of the bytes in flight.
            delivered_bytes: Bytes newly reported as received by the ACK number or by SACK.
            is_safe: True if the ACK acknowledges new data and shows no further loss. Slow start may then compensate
                for losses beyond the reduction (RFC 6937, 3, SSRB); Linux uses the same condition.
        """
        self._delivered_bytes += delivered_bytes
        deficit_bytes = self._delivered_bytes - self._sent_bytes
        if pipe_bytes > self._threshold_bytes:
            share = -(-self._delivered_bytes * self._threshold_bytes // self._flight_bytes)
            allowed_bytes = share - self._sent_bytes
        else:
            limit = max(deficit_bytes, delivered_bytes) + self._segment_bytes if is_safe else deficit_bytes
            allowed_bytes = min(self._threshold_bytes - pipe_bytes, limit)
        return pipe_bytes + max(allowed_bytes, 0)

    def on_sent(self, length: int) -> None:
        """Record sent data."""
        self._sent_bytes += length
