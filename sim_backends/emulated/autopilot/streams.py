"""How often one client hears each message (https://mavlink.io/en/mavgen_python/howto_requestmessages.html)."""

from collections.abc import Iterator
from typing import Final

from sim_backends.emulated.autopilot.mavlink import dialect

SHORTEST_NS: Final = 20_000_000
"""Nobody hears a message more often than this."""

_d = dialect
USUAL_HZ: Final = {
    _d.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    _d.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    _d.MAVLINK_MSG_ID_GPS_RAW_INT: 1.0,
    _d.MAVLINK_MSG_ID_ATTITUDE: 10.0,
    _d.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 10.0,
    _d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
    _d.MAVLINK_MSG_ID_MISSION_CURRENT: 1.0,
    _d.MAVLINK_MSG_ID_VFR_HUD: 2.0,
    _d.MAVLINK_MSG_ID_BATTERY_STATUS: 1.0,
    _d.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    _d.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 2.0,
}
"""Messages per second, for who asks for nothing."""

_GROUPS: Final = {
    _d.MAV_DATA_STREAM_EXTENDED_STATUS: (
        _d.MAVLINK_MSG_ID_SYS_STATUS,
        _d.MAVLINK_MSG_ID_GPS_RAW_INT,
        _d.MAVLINK_MSG_ID_MISSION_CURRENT,
    ),
    _d.MAV_DATA_STREAM_POSITION: (
        _d.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        _d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    ),
    _d.MAV_DATA_STREAM_EXTRA1: (_d.MAVLINK_MSG_ID_ATTITUDE,),
    _d.MAV_DATA_STREAM_EXTRA2: (_d.MAVLINK_MSG_ID_VFR_HUD,),
    _d.MAV_DATA_STREAM_EXTRA3: (_d.MAVLINK_MSG_ID_BATTERY_STATUS,),
}
"""What REQUEST_DATA_STREAM means by its streams."""


class Streams:
    """The messages that one client hears, each at its rate.

    Args:
        now_ns: From when on.
    """

    def __init__(self, now_ns: int) -> None:
        self._interval_ns = {kind: round(1e9 / rate_hz) for kind, rate_hz in USUAL_HZ.items()}
        self._due_ns = dict.fromkeys(self._interval_ns, now_ns)

    def due(self, now_ns: int) -> Iterator[int]:
        """Yield the ids of the messages that are due; what was missed meanwhile is not made up for."""
        for kind, due_ns in self._due_ns.items():
            if due_ns <= now_ns:
                interval_ns = self._interval_ns[kind]
                self._due_ns[kind] = now_ns + interval_ns - (now_ns - due_ns) % interval_ns
                yield kind

    @property
    def next_ns(self) -> int:
        """When the next one is due: there is always the heartbeat."""
        return min(self._due_ns.values())

    def set_interval(self, kind: int, interval_us: float, now_ns: int) -> None:
        """Set how often a message comes: -1 never, 0 as usual (MAV_CMD_SET_MESSAGE_INTERVAL)."""
        if interval_us == 0 and kind in USUAL_HZ:
            interval_us = 1e6 / USUAL_HZ[kind]
        self._due_ns.pop(kind, None)
        self._interval_ns.pop(kind, None)
        if interval_us > 0:
            self._interval_ns[kind] = max(round(interval_us * 1e3), SHORTEST_NS)
            self._due_ns[kind] = now_ns
        elif kind == dialect.MAVLINK_MSG_ID_HEARTBEAT:
            self.set_interval(kind, 1e6, now_ns)  # without it nobody knows that there is a vehicle

    def interval_us(self, kind: int) -> int:
        """Return how often a message comes, -1 for never."""
        return self._interval_ns.get(kind, -1000) // 1000

    def request(self, stream: int, rate_hz: int, now_ns: int) -> None:
        """Do what REQUEST_DATA_STREAM asks for, with rate 0 for its stop; unknown streams change nothing."""
        everything = stream == dialect.MAV_DATA_STREAM_ALL
        kinds = [one for group in _GROUPS.values() for one in group] if everything else _GROUPS.get(stream, ())
        for kind in kinds:
            self.set_interval(kind, 1e6 / rate_hz if rate_hz else -1, now_ns)
