"""Proportional rate reduction (RFC 6937): how much may be sent in a recovery, as Linux does it."""


class ProportionalReduction:
    """Brings what is under way down to the threshold over a round trip, never faster than data arrives.

    RFC 6675 alone would send as much at once as is found lost, into the queue that has just run over.

    Args:
        threshold_bytes: What shall be under way at the end.
        flight_bytes: What was sent and not acknowledged at the beginning (RecoverFS).
        segment_bytes: Data in a full segment.
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
            pipe_bytes: What is taken to be under way.
            delivered_bytes: What the ACK shows to have arrived, by its number or by SACK.
            safe: Whether the ACK is of new data and shows no further loss; then slow start may make up for what was
                lost beyond the reduction (RFC 6937, 3, SSRB), as Linux decides between the two bounds.
        """
        self._delivered_bytes += delivered_bytes
        behind_bytes = self._delivered_bytes - self._sent_bytes
        if pipe_bytes > self._threshold_bytes:
            share = -(-self._delivered_bytes * self._threshold_bytes // self._flight_bytes)
            more_bytes = share - self._sent_bytes
        else:
            limit = max(behind_bytes, delivered_bytes) + self._segment_bytes if safe else behind_bytes
            more_bytes = min(self._threshold_bytes - pipe_bytes, limit)
        return pipe_bytes + max(more_bytes, 0)

    def sent(self, length: int) -> None:
        """Take note of data that is sent."""
        self._sent_bytes += length
