"""Message rates of one port of the autopilot (https://mavlink.io/en/services/message_intervals.html).

Rates belong to the port: all clients receive the same messages, and each client can change the rates for all.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from sim_backends.emulated.autopilot.mavlink import dialect

MIN_INTERVAL_NS: Final = 20_000_000
"""Minimum interval of a message."""
HEARTBEAT_US: Final = 1_000_000


class Streams:
    """The messages that a port sends, each at its rate.

    Args:
        default_hz: Default rates by message id; 0 for all others.
        now_ns: Time of the first messages.
    """

    def __init__(self, default_hz: Mapping[int, float], now_ns: int) -> None:
        self._default_hz = {dialect.MAVLINK_MSG_ID_HEARTBEAT: 1e6 / HEARTBEAT_US, **default_hz}
        self._interval_ns = {kind: round(1e9 / rate_hz) for kind, rate_hz in self._default_hz.items() if rate_hz}
        self._due_ns = dict.fromkeys(self._interval_ns, now_ns)

    def due(self, now_ns: int) -> Iterator[int]:
        """Yield the ids of the messages that are due; missed messages are not sent later."""
        for kind, due_ns in self._due_ns.items():
            if due_ns <= now_ns:
                interval_ns = self._interval_ns[kind]
                self._due_ns[kind] = now_ns + interval_ns - (now_ns - due_ns) % interval_ns
                yield kind

    @property
    def next_ns(self) -> int:
        """Time of the next message; the heartbeat is always sent."""
        return min(self._due_ns.values())

    def set_interval(self, kind: int, interval_us: float, now_ns: int) -> None:
        """Set the interval of a message: -1 disables it, 0 is the default (MAV_CMD_SET_MESSAGE_INTERVAL)."""
        if interval_us == 0 and self._default_hz.get(kind):
            interval_us = 1e6 / self._default_hz[kind]
        self._due_ns.pop(kind, None)
        self._interval_ns.pop(kind, None)
        if interval_us > 0:
            self._interval_ns[kind] = max(round(interval_us * 1e3), MIN_INTERVAL_NS)
            self._due_ns[kind] = now_ns
        elif kind == dialect.MAVLINK_MSG_ID_HEARTBEAT:
            self.set_interval(kind, HEARTBEAT_US, now_ns)  # clients detect a vehicle only by its heartbeat

    def interval_us(self, kind: int) -> int:
        """Return the interval of a message, or -1 if it is disabled."""
        return self._interval_ns.get(kind, -1000) // 1000

    def set_default(self, kind: int, rate_hz: float, now_ns: int) -> None:
        """Set the default rate of a message, and its current rate; 0 disables it."""
        self._default_hz[kind] = rate_hz
        self.set_interval(kind, 1e6 / rate_hz if rate_hz else -1, now_ns)
