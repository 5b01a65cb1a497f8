"""The retransmission timeout of RFC 6298, in whole nanoseconds."""

from sim_backends.network.tcp.options import TcpOptions


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
        self.timeout_ns = options.first_timeout_ns

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
        timeout_ns = self.smoothed_ns + max(options.clock_ns, 4 * self.variation_ns)
        self.timeout_ns = min(max(timeout_ns, options.least_timeout_ns), options.longest_timeout_ns)

    def back_off(self) -> None:
        """Double the timeout (RFC 6298, 5.5)."""
        self.timeout_ns = min(2 * self.timeout_ns, self._options.longest_timeout_ns)
