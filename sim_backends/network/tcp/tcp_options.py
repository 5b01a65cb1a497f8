"""Options of TCP. The defaults are those of Linux, except `nagle`."""

from dataclasses import dataclass
from typing import Final, Literal

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.tcp.segments import HEADER_BYTES

_MS: Final = 1_000_000
_SECOND: Final = 1_000_000_000


Congestion = Literal["cubic", "cubic-rfc9438", "newreno"]
"""Congestion control and loss recovery: Linux's `tcp_cubic` with RACK (RFC 8985); CUBIC of RFC 9438, or NewReno (RFC
5681, 6582), both with the loss recovery of RFC 6675.
"""


@dataclass(frozen=True)
class TcpOptions:
    """Options of TCP.

    Attributes:
        mtu_bytes: The largest IP packet; 1500 gives segments of 1448 data bytes.
        initial_window_segments: Initial congestion window (RFC 6928).
        congestion: Congestion control and loss recovery; `cubic` is Linux's default.
        receive_window_bytes: Bytes that a receiver can buffer while earlier data is missing. 3 MiB is the limit of
            Linux's autotuning: half of the maximum of 6 MiB in `tcp_rmem`, by `tcp_adv_win_scale`.
        min_timeout_ns: Minimum retransmission timeout: 1 s in RFC 6298. The default is the 200 ms of Linux
            (TCP_RTO_MIN), but Linux applies them to the variance term, so its timeouts are longer by up to a round
            trip.
        max_timeout_ns: Maximum retransmission timeout (Linux: TCP_RTO_MAX).
        initial_timeout_ns: Timeout until the first round trip has been measured (RFC 6298, 2.1).
        clock_granularity_ns: Clock granularity G of RFC 6298: the minimum of the variance term of a timeout.
        syn_retries: Maximum number of SYN retransmissions (Linux: tcp_syn_retries).
        retries: Maximum number of consecutive retransmission timeouts without progress before the connection is given
            up (Linux: tcp_retries2).
        delayed_ack_ns: Maximum delay of an ACK by the receiver. Linux adapts it, between 40 and 200 ms.
        segments_per_ack: Number of received segments after which an ACK is sent immediately (RFC 5681, 4.2); with 1,
            no ACK is delayed.
        nagle: If True, a small segment waits while others are in flight (RFC 896), as in Linux without TCP_NODELAY.
            TCPROS sets TCP_NODELAY only if the subscriber requests it, which is assumed here.
        restart_after_idle: If True, a congestion window above the initial window is reduced to it when data is sent
            after an idle time of more than a retransmission timeout (RFC 5681, 4.1). Linux halves the window for each
            timeout of the idle time.
        bytes_counted_segments: Maximum increase of the congestion window per ACK in slow start, in segments; None for
            all acknowledged bytes, as in Linux. RFC 5681 has 1, RFC 3465 up to 2.

    Raises:
        ConfigurationError: A value is below its minimum.
    """

    mtu_bytes: int = 1500
    initial_window_segments: int = 10
    congestion: Congestion = "cubic"
    receive_window_bytes: int = 3 << 20
    min_timeout_ns: int = 200 * _MS
    max_timeout_ns: int = 120 * _SECOND
    initial_timeout_ns: int = _SECOND
    clock_granularity_ns: int = _MS
    syn_retries: int = 6
    retries: int = 15
    delayed_ack_ns: int = 40 * _MS
    segments_per_ack: int = 2
    nagle: bool = False
    restart_after_idle: bool = True
    bytes_counted_segments: int | None = None

    def __post_init__(self) -> None:
        minimums = {
            # RFC 791: every host must accept this size. It leaves 524 data bytes per segment.
            "mtu_bytes": 576,
            "initial_window_segments": 1,
            "receive_window_bytes": self.segment_bytes,
            "min_timeout_ns": 1,
            "max_timeout_ns": max(self.min_timeout_ns, self.initial_timeout_ns),
            "initial_timeout_ns": 1,
            "clock_granularity_ns": 1,
            "syn_retries": 0,
            "retries": 0,
            "delayed_ack_ns": 0,
            "segments_per_ack": 1,
        }
        for name, minimum in minimums.items():
            value = getattr(self, name)
            if value < minimum:
                raise ConfigurationError(f"{name} of TCP is {value}", remedy=f"set it to at least {minimum}")
        if self.bytes_counted_segments is not None and self.bytes_counted_segments < 1:
            raise ConfigurationError(
                f"bytes_counted_segments of TCP is {self.bytes_counted_segments}",
                remedy="set it to at least 1, or to None",
            )

    @property
    def segment_bytes(self) -> int:
        """Data bytes in a full segment, without the headers and the timestamps option."""
        return self.mtu_bytes - HEADER_BYTES
