"""Message rates of one port of the autopilot (https://mavlink.io/en/services/message_intervals.html).

They belong to the port: all clients receive the same messages, and each client can change their rates for all.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from sim_backends.emulated.autopilot.mavlink import dialect

SHORTEST_NS: Final = 20_000_000
"""Shortest interval of a message."""
HEARTBEAT_US: Final = 1_000_000


class Streams:
    """The messages that a port sends, each at its rate.

    Args:
        usual_hz: Default rates, by message id; others are 0.
        now_ns: Time of the first messages.
    """

    def __init__(self, usual_hz: Mapping[int, float], now_ns: int) -> None:
        self._usual_hz = {dialect.MAVLINK_MSG_ID_HEARTBEAT: 1e6 / HEARTBEAT_US, **usual_hz}
        self._interval_ns = {kind: round(1e9 / rate_hz) for kind, rate_hz in self._usual_hz.items() if rate_hz}
        self._due_ns = dict.fromkeys(self._interval_ns, now_ns)

    def due(self, now_ns: int) -> Iterator[int]:
        """Yield the ids of the messages that are due; messages missed meanwhile are not sent later."""
        for kind, due_ns in self._due_ns.items():
            if due_ns <= now_ns:
                interval_ns = self._interval_ns[kind]
                self._due_ns[kind] = now_ns + interval_ns - (now_ns - due_ns) % interval_ns
                yield kind

    @property
    def next_ns(self) -> int:
        """Time of the next message: there is always the heartbeat."""
        return min(self._due_ns.values())

    def set_interval(self, kind: int, interval_us: float, now_ns: int) -> None:
        """Set the interval of a message: -1 is never, 0 the default (MAV_CMD_SET_MESSAGE_INTERVAL)."""
        if interval_us == 0 and self._usual_hz.get(kind):
            interval_us = 1e6 / self._usual_hz[kind]
        self._due_ns.pop(kind, None)
        self._interval_ns.pop(kind, None)
        if interval_us > 0:
            self._interval_ns[kind] = max(round(interval_us * 1e3), SHORTEST_NS)
            self._due_ns[kind] = now_ns
        elif kind == dialect.MAVLINK_MSG_ID_HEARTBEAT:
            self.set_interval(kind, HEARTBEAT_US, now_ns)  # without it no client recognises a vehicle

    def interval_us(self, kind: int) -> int:
        """Return the interval of a message, -1 for never."""
        return self._interval_ns.get(kind, -1000) // 1000

    def set_usual(self, kind: int, rate_hz: float, now_ns: int) -> None:
        """Set the default rate of a message, and its rate now; 0 is never."""
        self._usual_hz[kind] = rate_hz
        self.set_interval(kind, 1e6 / rate_hz if rate_hz else -1, now_ns)
