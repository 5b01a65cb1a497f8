"""What a program on a drone's own computer knows of its autopilot, and what it tells it, by MAVLink.

Messages, commands and their numbers are those of https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import math
import struct
import time

from fieldkit.agent.mavlink_frames import (
    ATTITUDE,
    COMMAND_ACK,
    COMMAND_LONG,
    EXTRA,
    HEARTBEAT,
    LOCAL_POSITION_NED,
    NO_AUTOPILOT,
    SET_POINT,
    STATUSTEXT,
    FrameWriter,
    head,
    is_sound,
)
from fieldkit.agent.mavlink_links import FlightLink

ARM, LAND, RETURN, SET_MODE, SET_INTERVAL = 400, 21, 20, 176, 511
ACCEPTED = 0
PX4 = 12
OFFBOARD = 6
"""PX4's main mode, in which it goes where set-points say (px4_custom_mode.h)."""

FRESH_S = 2.0
"""What was heard longer ago says nothing of now."""

_FLOATS = struct.Struct("<I6f")
_ARMED = 0x80
_CUSTOM_MODE = 1
_LOCAL_NED = 1
_PLACE_ALONE = 0b110111111000
"""Of a set-point the place counts, and neither velocity, acceleration nor yaw."""
_OWN = 245, 191
"""System and component of who speaks: an on-board computer (MAV_COMP_ID_ONBOARD_COMPUTER) of a ground station."""
_ONBOARD = 18
_WIDEST = struct.Struct("<I11fHBBB").size


class AutopilotState:
    """An autopilot as it says that it is.

    Args:
        link: The way to it.
        system: Its system id; 0 for the first that is heard.

    Attributes:
        armed: Whether its motors may turn.
        offboard: Whether it goes where set-points say.
        px4: Whether it is PX4.
        place_m: Where it is: north, east, down of where it was switched on; None where it has not said of late.
        speed_m_s: How fast it moves.
        yaw_rad: Where its nose points, from north over east; None likewise.
        said: What it wanted to tell people last.
        answers: The result of the last answer to each command.
    """

    def __init__(self, link: FlightLink, system: int) -> None:
        self._link = link
        self._system = system
        self._who: tuple[int, int] | None = None
        self._writer = FrameWriter(*_OWN)
        self._heard_s = self._placed_s = self._turned_s = -math.inf
        self._place_m = (0.0, 0.0, 0.0)
        self._yaw_rad = self.speed_m_s = 0.0
        self.armed = self.offboard = self.px4 = False
        self.said = ""
        self.answers: dict[int, int] = {}

    @property
    def alive(self) -> bool:
        """Whether its heart beats."""
        return time.monotonic() - self._heard_s < 2 * FRESH_S

    @property
    def place_m(self) -> tuple[float, float, float] | None:
        """See the class."""
        return self._place_m if time.monotonic() - self._placed_s < FRESH_S else None

    @property
    def yaw_rad(self) -> float | None:
        """See the class."""
        return self._yaw_rad if time.monotonic() - self._turned_s < FRESH_S else None

    def receive(self) -> None:
        """Take what has come. What is damaged, or from somebody else, counts for nothing."""
        for frame in self._link.receive():
            found = head(frame)
            if found.kind not in EXTRA or not is_sound(frame, found.kind):
                continue
            self._take(found.kind, (found.system, found.component), found.payload.ljust(_WIDEST, b"\0"))

    def _take(self, kind: int, who: tuple[int, int], payload: bytes) -> None:
        now_s = time.monotonic()
        if kind == HEARTBEAT:
            mode, _, autopilot, base = struct.unpack_from("<IBBB", payload)
            known = who == self._who if self._who else self._system in (0, who[0])
            if autopilot == NO_AUTOPILOT or not known:
                return
            self._who, self._heard_s = who, now_s
            self.px4, self.armed, self.offboard = autopilot == PX4, bool(base & _ARMED), mode >> 16 & 0xFF == OFFBOARD
        if who != self._who:
            return
        if kind == LOCAL_POSITION_NED:
            _, *values = _FLOATS.unpack_from(payload)
            if all(map(math.isfinite, values)):
                self._place_m, self._placed_s = (values[0], values[1], values[2]), now_s
                self.speed_m_s = math.hypot(*values[3:])
        elif kind == ATTITUDE:
            yaw_rad = _FLOATS.unpack_from(payload)[3]
            if math.isfinite(yaw_rad):
                self._yaw_rad, self._turned_s = yaw_rad, now_s
        elif kind == COMMAND_ACK:
            command, result = struct.unpack_from("<HB", payload)
            self.answers[command] = result
        elif kind == STATUSTEXT:
            self.said = payload[1:51].split(b"\0")[0].decode("ascii", "replace")

    def beat(self) -> None:
        """Tell it that somebody is there."""
        self._send(HEARTBEAT, struct.pack("<IBBBBB", 0, _ONBOARD, NO_AUTOPILOT, 0, 4, 3))

    def ask_for(self, kind: int, rate_hz: float) -> None:
        """Ask it to send a message so often."""
        self.command(SET_INTERVAL, kind, 1e6 / rate_hz)

    def command(self, command: int, *parameters: float) -> None:
        """Send a command; `answers` will have what it said to it."""
        if self._who is not None:
            seven = (*parameters, *(0.0,) * (7 - len(parameters)))
            self._send(COMMAND_LONG, struct.pack("<7fHBBB", *seven, command, *self._who, 0))

    def lead(self, place_m: tuple[float, float, float]) -> None:
        """Send a set-point: to be there, north, east, down of where it was switched on."""
        if self._who is not None:
            now_ms = int(time.monotonic() * 1e3) & 0xFFFFFFFF
            places = (now_ms, *place_m, *(0.0,) * 8)
            self._send(SET_POINT, struct.pack("<I11fHBBB", *places, _PLACE_ALONE, *self._who, _LOCAL_NED))

    def go_offboard(self) -> None:
        """Ask it to go where set-points say."""
        self.command(SET_MODE, _CUSTOM_MODE, OFFBOARD)

    def _send(self, kind: int, payload: bytes) -> None:
        self._link.send(self._writer.frame(kind, payload))
