"""Proportional rate reduction (RFC 6937): the bytes that may be sent in a recovery, as in Linux."""


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

    def window_bytes(self, pipe_bytes: int, delivered_bytes: int, *, safe: bool) -> int:
        """Return the window after an ACK.

        Args:
            pipe_bytes: Estimate of the bytes in flight.
            delivered_bytes: Bytes newly reported as received by the ACK number or by SACK.
            safe: True if the ACK acknowledges new data and shows no further loss. Slow start may then compensate for
                losses beyond the reduction (RFC 6937, 3, SSRB); Linux uses the same condition.
        """
        self._delivered_bytes += delivered_bytes
        deficit_bytes = self._delivered_bytes - self._sent_bytes
        if pipe_bytes > self._threshold_bytes:
            share = -(-self._delivered_bytes * self._threshold_bytes // self._flight_bytes)
            allowed_bytes = share - self._sent_bytes
        else:
            limit = max(deficit_bytes, delivered_bytes) + self._segment_bytes if safe else deficit_bytes
            allowed_bytes = min(self._threshold_bytes - pipe_bytes, limit)
        return pipe_bytes + max(allowed_bytes, 0)

    def on_sent(self, length: int) -> None:
        """Record sent data."""
        self._sent_bytes += length
