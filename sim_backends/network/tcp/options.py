"""Options of TCP; the defaults are those of Linux."""

from dataclasses import dataclass
from typing import Final, Literal

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.tcp.segments import HEADER_BYTES

_MS: Final = 1_000_000
_SECOND: Final = 1_000_000_000


Congestion = Literal["cubic", "cubic-rfc9438", "newreno"]
"""Congestion control and loss recovery: Linux's `tcp_cubic` with RACK (RFC 8985); CUBIC of RFC 9438, or NewReno (RFC
5681, 6582), both with the loss recovery of RFC 6675."""


@dataclass(frozen=True)
class TcpOptions:
    """What can be chosen.

    Attributes:
        mtu_bytes: The largest IP packet; 1500 leaves segments of 1448 bytes beside the headers.
        initial_window_segments: Congestion window at the beginning (RFC 6928).
        congestion: Congestion control and loss recovery; `cubic` is Linux's default.
        receive_window_bytes: What a receiver holds that waits for what is missing. 3 MiB is what Linux grows to: half
            of `tcp_rmem`'s largest 6 MiB, by `tcp_adv_win_scale`.
        least_timeout_ns: The shortest retransmission timeout: 200 ms in Linux, 1 s in RFC 6298.
        longest_timeout_ns: The longest (Linux: TCP_RTO_MAX).
        first_timeout_ns: The timeout before any round trip was measured (RFC 6298, 2.1).
        clock_ns: Granularity G of the clock in RFC 6298: the least variance that a timeout allows for.
        syn_retries: How often a SYN is sent again (Linux: tcp_syn_retries).
        retries: How often data is sent again by timeout, without any progress, before the connection is given up
            (Linux: tcp_retries2).
        delayed_ack_ns: How long a receiver keeps an ACK back (Linux: 40 ms).
        segments_per_ack: It keeps none back for more than this many segments (RFC 5681, 4.2); 1 delays no ACK.
        nagle: Whether a small segment waits while others are under way (RFC 896). The TCP of DDS switches it off by
            TCP_NODELAY; TCPROS does so only for a subscriber that asks for it, as those here are taken to.
        restart_after_idle: Whether the window falls back to the initial one after silence (RFC 5681, 4.1).
        bytes_counted_segments: By how many segments at most an ACK opens the window in slow start; None is by all
            that it acknowledges, as Linux does. RFC 5681 has 1, RFC 3465 up to 2.

    Raises:
        ConfigurationError: A value that no connection could work with.
    """

    mtu_bytes: int = 1500
    initial_window_segments: int = 10
    congestion: Congestion = "cubic"
    receive_window_bytes: int = 3 << 20
    least_timeout_ns: int = 200 * _MS
    longest_timeout_ns: int = 120 * _SECOND
    first_timeout_ns: int = _SECOND
    clock_ns: int = _MS
    syn_retries: int = 6
    retries: int = 15
    delayed_ack_ns: int = 40 * _MS
    segments_per_ack: int = 2
    nagle: bool = False
    restart_after_idle: bool = True
    bytes_counted_segments: int | None = None

    def __post_init__(self) -> None:
        least = {
            # RFC 791: what every host takes. It leaves 524 bytes beside the headers.
            "mtu_bytes": 576,
            "initial_window_segments": 1,
            "receive_window_bytes": self.segment_bytes,
            "least_timeout_ns": 1,
            "longest_timeout_ns": max(self.least_timeout_ns, self.first_timeout_ns),
            "first_timeout_ns": 1,
            "clock_ns": 1,
            "syn_retries": 0,
            "retries": 0,
            "delayed_ack_ns": 0,
            "segments_per_ack": 1,
        }
        for name, bound in least.items():
            value = getattr(self, name)
            if value < bound:
                raise ConfigurationError(f"{name} of TCP is {value}", remedy=f"give it at least {bound}")
        if self.bytes_counted_segments is not None and self.bytes_counted_segments < 1:
            raise ConfigurationError(
                f"bytes_counted_segments of TCP is {self.bytes_counted_segments}",
                remedy="give it at least 1, or none",
            )

    @property
    def segment_bytes(self) -> int:
        """Data in a full segment, beside the headers with the timestamps option."""
        return self.mtu_bytes - HEADER_BYTES
