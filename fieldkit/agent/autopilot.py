"""State of a drone's autopilot, and commands to it, over MAVLink, for programs on the drone's own computer.

Messages, commands and their numbers are those of https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import math
import selectors
import struct
import time
from dataclasses import dataclass
from typing import Callable, Sequence

from fieldkit.agent.arducopter import ArduCopter
from fieldkit.agent.dialect import REQUEST, FlightDialect
from fieldkit.agent.mavlink_frames import (
    ATTITUDE,
    COMMAND_ACK,
    EKF_STATUS_REPORT,
    ESTIMATOR_STATUS,
    HEARTBEAT,
    HOME_POSITION,
    LOCAL_POSITION_NED,
    NO_AUTOPILOT,
    PARAM_REQUEST_READ,
    PARAM_VALUE,
    SET_MESSAGE_INTERVAL,
    SET_POINT,
    STATUSTEXT,
    SYS_STATUS,
    FrameWriter,
    head,
    is_intact,
)
from fieldkit.agent.mavlink_links import FlightLink
from fieldkit.agent.px4 import Px4

FRESH_S = 2.0
"""What was heard longer ago says nothing of now."""

_DIALECTS: Sequence[FlightDialect] = (Px4(), ArduCopter())
_BEAT_S = 1.0
_FLOATS = struct.Struct("<I6f")
_STATUS = struct.Struct("<IIIHHhHHHHHHb")
_CHUNK = struct.Struct("<HB")
_ARMED = 0x80
_LOCAL_NED = 1
_PLACE_ALONE = 0b110111111000
"""Of a set-point the place counts, and neither velocity, acceleration nor yaw."""
_OWN = 245, 191
"""System and component of who speaks: an on-board computer (MAV_COMP_ID_ONBOARD_COMPUTER) of a ground station."""
_ONBOARD = 18
"""MAV_TYPE_ONBOARD_CONTROLLER."""
_WIDEST = 255
_WARNING = 4
"""MAV_SEVERITY_WARNING; what is worse has a lower number."""
_MOST_TEXTS, _MOST_CHARACTERS = 30, 500
_NAME_BYTES = 16


@dataclass(frozen=True)
class SystemStatus:
    """What SYS_STATUS says.

    Attributes:
        ill: Bits of what is there, in use, and not healthy (MAV_SYS_STATUS_SENSOR).
        charge: What is left in the battery, of 1; None where it does not know.
        heard_s: When it said so.
    """

    ill: int
    charge: float | None
    heard_s: float


class AutopilotState:
    """An autopilot as it says that it is.

    Args:
        link: The way to it; the first autopilot that is heard there is the one.

    Attributes:
        armed: Whether its motors may turn.
        dialect: How it is flown; None for one of a family that is not known here, or that was not heard yet.
        family: Its MAV_AUTOPILOT and MAV_TYPE.
        place_m: Where it is: north, east, down of where it was switched on; None where it has not said of late.
        speed_m_s: How fast it moves.
        yaw_rad: Where its nose points, from north over east; None likewise.
        status: Its health and its battery; None where it has not said.
        estimate: Flags of its estimate of position (ESTIMATOR_STATUS_FLAGS); None likewise.
        has_home: Whether it has told where its home is.
        parameters: Its parameters, as far as it was asked for them.
        texts: What it wanted to tell people, warnings and worse, the last at the end.
        answers: The result of the last answer to each command.
    """

    def __init__(self, link: FlightLink) -> None:
        self._link = link
        self._who: tuple[int, int] | None = None
        self._writer = FrameWriter(*_OWN)
        self._heard_s = self._placed_s = self._turned_s = -math.inf
        self._place_m = (0.0, 0.0, 0.0)
        self._yaw_rad = self.speed_m_s = 0.0
        self._mode = self._text_id = 0
        self.armed = self.has_home = False
        self.dialect: FlightDialect | None = None
        self.family = (NO_AUTOPILOT, 0)
        self.status: SystemStatus | None = None
        self.estimate: int | None = None
        self.parameters: dict[str, float] = {}
        self.texts: list[str] = []
        self.answers: dict[int, int] = {}
        self._takers: dict[int, Callable[[bytes], None]] = {
            LOCAL_POSITION_NED: self._take_place,
            ATTITUDE: self._take_attitude,
            COMMAND_ACK: self._take_answer,
            STATUSTEXT: self._take_text,
            SYS_STATUS: self._take_status,
            ESTIMATOR_STATUS: lambda payload: self._take_estimate(payload, "<40xH"),
            EKF_STATUS_REPORT: lambda payload: self._take_estimate(payload, "<20xH"),
            HOME_POSITION: lambda _: setattr(self, "has_home", True),
            PARAM_VALUE: self._take_parameter,
        }

    @property
    def alive(self) -> bool:
        """Whether its heart beats."""
        return self.silent_s < 2 * FRESH_S

    @property
    def silent_s(self) -> float:
        """For how long its heart was not heard; without end before it first was."""
        return time.monotonic() - self._heard_s

    @property
    def guided(self) -> bool:
        """Whether it goes where set-points say."""
        return self.dialect is not None and self.dialect.is_guided(self._mode)

    @property
    def place_m(self) -> tuple[float, float, float] | None:
        """See the class."""
        return self._place_m if time.monotonic() - self._placed_s < FRESH_S else None

    @property
    def yaw_rad(self) -> float | None:
        """See the class."""
        return self._yaw_rad if time.monotonic() - self._turned_s < FRESH_S else None

    @property
    def said(self) -> str:
        """What it wanted to tell people last."""
        return self.texts[-1] if self.texts else ""

    def receive(self) -> None:
        """Take what has come. What is damaged, or from somebody else, counts for nothing."""
        for frame in self._link.receive():
            if not is_intact(frame):
                continue
            found = head(frame)
            who, payload = (found.system, found.component), found.payload.ljust(_WIDEST, b"\0")
            if found.kind == HEARTBEAT:
                self._take_heartbeat(who, payload)
            elif who == self._who and found.kind in self._takers:
                self._takers[found.kind](payload)

    def _take_heartbeat(self, who: tuple[int, int], payload: bytes) -> None:
        mode, vehicle, autopilot, base = struct.unpack_from("<IBBB", payload)
        if autopilot == NO_AUTOPILOT or self._who not in (None, who):
            return
        self._who, self._heard_s, self._mode = who, time.monotonic(), mode
        self.armed, self.family = bool(base & _ARMED), (autopilot, vehicle)
        self.dialect = next((dialect for dialect in _DIALECTS if dialect.speaks(autopilot, vehicle)), None)

    def _take_place(self, payload: bytes) -> None:
        _, *values = _FLOATS.unpack_from(payload)
        if all(map(math.isfinite, values)):
            self._place_m, self._placed_s = (values[0], values[1], values[2]), time.monotonic()
            self.speed_m_s = math.hypot(*values[3:])

    def _take_attitude(self, payload: bytes) -> None:
        yaw_rad = _FLOATS.unpack_from(payload)[3]
        if math.isfinite(yaw_rad):
            self._yaw_rad, self._turned_s = yaw_rad, time.monotonic()

    def _take_answer(self, payload: bytes) -> None:
        command, result = struct.unpack_from("<HB", payload)
        self.answers[command] = result

    def _take_text(self, payload: bytes) -> None:
        """Keep a text for people; a long one comes in pieces of one number (STATUSTEXT, id and chunk_seq)."""
        text = payload[1:51].split(b"\0")[0].decode("ascii", "replace")
        number, piece = _CHUNK.unpack_from(payload, 51)
        if payload[0] > _WARNING:
            return
        if piece and number == self._text_id and self.texts:
            self.texts[-1] = (self.texts[-1] + text)[:_MOST_CHARACTERS]
        elif not piece:
            self.texts = [*self.texts[1 - _MOST_TEXTS :], text]
        self._text_id = number

    def _take_status(self, payload: bytes) -> None:
        present, enabled, health, *_, left = _STATUS.unpack_from(payload)
        charge = left / 100 if left >= 0 else None
        self.status = SystemStatus(present & enabled & ~health, charge, time.monotonic())

    def _take_estimate(self, payload: bytes, form: str) -> None:
        (self.estimate,) = struct.unpack_from(form, payload)

    def _take_parameter(self, payload: bytes) -> None:
        (value,) = struct.unpack_from("<f", payload)
        name = payload[8 : 8 + _NAME_BYTES].split(b"\0")[0].decode("ascii", "replace")
        if math.isfinite(value):
            self.parameters[name] = value

    def beat(self) -> None:
        """Tell it that somebody is there."""
        self._link.send(self._writer.heartbeat(_ONBOARD))

    def ask_for(self, kind: int, rate_hz: float) -> None:
        """Ask it to send a message so often; 0 for as often as usual."""
        self.command(SET_MESSAGE_INTERVAL, kind, 1e6 / rate_hz if rate_hz else 0)

    def ask_once(self, kind: int) -> None:
        """Ask it to send a message now."""
        self.command(REQUEST, kind)

    def ask_parameter(self, name: str) -> None:
        """Ask it for a parameter; `parameters` will have it, if there is one."""
        if self._who is not None:
            named = name.encode("ascii").ljust(_NAME_BYTES, b"\0")
            self._send(PARAM_REQUEST_READ, struct.pack("<hBB16s", -1, *self._who, named))

    def command(self, command: float, *parameters: float) -> None:
        """Send a command; `answers` will have what it said to it."""
        if self._who is not None:
            self._link.send(self._writer.command(self._who, int(command), *parameters))

    def lead(self, place_m: tuple[float, float, float]) -> None:
        """Send a set-point: to be there, north, east, down of where it was switched on."""
        if self._who is not None:
            now_ms = int(time.monotonic() * 1e3) & 0xFFFFFFFF
            places = (now_ms, *place_m, *(0.0,) * 8)
            self._send(SET_POINT, struct.pack("<I11fHBBB", *places, _PLACE_ALONE, *self._who, _LOCAL_NED))

    def _send(self, kind: int, payload: bytes) -> None:
        self._link.send(self._writer.frame(kind, payload))


class AutopilotTalk:
    """Lets an autopilot hear that somebody is there, and hears what it says.

    Args:
        link: The way to it.
        look: Called at the end of each turn, with what it says.

    Attributes:
        drone: What it says.
    """

    def __init__(self, link: FlightLink, look: Callable[[AutopilotState], None] = lambda _: None) -> None:
        self._look = look
        self.drone = AutopilotState(link)
        self._waiting = selectors.DefaultSelector()
        self._waiting.register(link.fileno(), selectors.EVENT_READ)
        self._beat_s = 0.0

    def turn(self, lasts_s: float) -> None:
        """Hear and speak for so long."""
        end_s = time.monotonic() + lasts_s
        if time.monotonic() > self._beat_s:
            self._beat_s = time.monotonic() + _BEAT_S
            self.drone.beat()
        while (left_s := end_s - time.monotonic()) > 0:
            if self._waiting.select(left_s):
                self.drone.receive()
        self._look(self.drone)
