"""State of a drone's autopilot, and commands to it, over MAVLink, for programs on the drone's own computer.

Messages, commands and their numbers are those of https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import math
import struct
import time
from dataclasses import dataclass
from typing import Callable, Sequence

from fieldkit.agent.arducopter import ArduCopter
from fieldkit.agent.dialect import REQUEST, FlightDialect
from fieldkit.agent.flying.reports import AutopilotTexts, printable
from fieldkit.agent.mavlink_frames import (
    ATTITUDE,
    COMMAND_ACK,
    EKF_STATUS_REPORT,
    ESTIMATOR_STATUS,
    GLOBAL_POSITION_INT,
    HEARTBEAT,
    HOME_POSITION,
    IN_PROGRESS,
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
"""A report that is older does not describe the present state."""
PILOT, GUARD, PREFLIGHT = 191, 192, 193
"""Components of our programs: MAV_COMP_ID_ONBOARD_COMPUTER and the next two."""

_DIALECTS: Sequence[FlightDialect] = (Px4(), ArduCopter())
_FLOATS = struct.Struct("<I6f")
_STATUS = struct.Struct("<IIIHHhHHHHHHb")
_ANSWER = struct.Struct("<HBBiBB")
"""COMMAND_ACK: command, result, progress, result_param2, target_system, target_component; the last four are
extensions of MAVLink 2."""
_ARMED = 0x80
_CRITICAL = 5
"""MAV_STATE_CRITICAL: PX4 reports it while a failsafe is active (HEARTBEAT.hpp), ArduPilot likewise."""
_LOCAL_NED = 1
_PLACE_AND_YAW = 0b100111111000
"""POSITION_TARGET_TYPEMASK: position and yaw count; velocity, acceleration and yaw rate are ignored."""
_OWN_SYSTEM = 245
"""The system id of our programs, as of a ground station."""
_ONBOARD = 18
"""MAV_TYPE_ONBOARD_CONTROLLER."""
_WIDEST = 255
_NAME_BYTES = 16


@dataclass(frozen=True)
class SystemStatus:
    """Content of SYS_STATUS.

    Attributes:
        ill: Bits of what is present, enabled, and not healthy (MAV_SYS_STATUS_SENSOR).
        charge: Remaining charge of the battery, of 1; None where it is unknown.
        heard_s: When it arrived, by the monotonic clock.
    """

    ill: int
    charge: float | None
    heard_s: float


class AutopilotState:
    """State of an autopilot by its own reports, and commands to it.

    Args:
        link: The connection to it; the first autopilot that is heard there is the one.
        component: Component id of the program that speaks.

    Attributes:
        armed: Whether its motors may turn.
        failsafe: Whether a failsafe of its own is active.
        mode: Its custom mode, as its heartbeat has it.
        dialect: How its family is flown; None for a family that is not known here, or before its first heartbeat.
        family: Its MAV_AUTOPILOT and MAV_TYPE.
        place_m: Position: north, east, down in LOCAL_POSITION_NED; None where no fresh report exists.
        speed_m_s: Its speed.
        yaw_rad: Direction of its nose, from north to east; None likewise.
        degrees: Latitude and longitude; None where no fresh report exists, or it does not know them.
        status: Its health and its battery; None where it has not reported them.
        estimate: Flags of its estimate of position (ESTIMATOR_STATUS_FLAGS); None likewise.
        has_home: Whether it has reported the position of its home.
        parameters: Its parameters, as far as they were requested.
        texts: Its texts for people.
        answers: The final result of the last answer to each command.
    """

    def __init__(self, link: FlightLink, component: int = PILOT) -> None:
        self.link = link
        self._own = _OWN_SYSTEM, component
        self._who: tuple[int, int] | None = None
        self._writer = FrameWriter(*self._own)
        self._heard_s = self._placed_s = self._turned_s = self._located_s = -math.inf
        self._place_m = (0.0, 0.0, 0.0)
        self._degrees = (0.0, 0.0)
        self._yaw_rad = self.speed_m_s = self._boot_s = 0.0
        self.mode = 0
        self.armed = self.failsafe = self.has_home = False
        self.dialect: FlightDialect | None = None
        self.family = (NO_AUTOPILOT, 0)
        self.status: SystemStatus | None = None
        self.estimate: int | None = None
        self.parameters: dict[str, float] = {}
        self.texts = AutopilotTexts()
        self.answers: dict[int, int] = {}
        self._takers: dict[int, Callable[[bytes], None]] = {
            LOCAL_POSITION_NED: self._take_place,
            GLOBAL_POSITION_INT: self._take_degrees,
            ATTITUDE: self._take_attitude,
            COMMAND_ACK: self._take_answer,
            STATUSTEXT: self.texts.take,
            SYS_STATUS: self._take_status,
            ESTIMATOR_STATUS: lambda payload: self._take_estimate(payload, "<40xH"),
            EKF_STATUS_REPORT: lambda payload: self._take_estimate(payload, "<20xH"),
            HOME_POSITION: lambda _: setattr(self, "has_home", True),
            PARAM_VALUE: self._take_parameter,
        }

    @property
    def alive(self) -> bool:
        """Whether its last heartbeat is recent."""
        return self.silent_s < 2 * FRESH_S

    @property
    def system(self) -> int:
        """Its system id; 0 before its first heartbeat."""
        return self._who[0] if self._who else 0

    @property
    def silent_s(self) -> float:
        """Time since its last heartbeat; infinite before the first."""
        return time.monotonic() - self._heard_s

    @property
    def guided(self) -> bool:
        """Whether it follows set-points in its mode."""
        return self.dialect is not None and self.dialect.is_guided(self.mode)

    @property
    def comes_down(self) -> bool:
        """Whether it lands or returns by itself in its mode."""
        return self.dialect is not None and self.dialect.comes_down(self.mode)

    @property
    def mode_name(self) -> str:
        """The name of its mode in its own documentation; its number for an unknown one."""
        return self.dialect.mode_name(self.mode) if self.dialect else str(self.mode)

    @property
    def place_m(self) -> tuple[float, float, float] | None:
        """See the class."""
        return self._place_m if self.unplaced_s < FRESH_S else None

    @property
    def unplaced_s(self) -> float:
        """Time since its last report of its position; infinite before the first."""
        return time.monotonic() - self._placed_s

    @property
    def last_place_m(self) -> tuple[float, float, float] | None:
        """Its last reported position, however old; None before the first."""
        return self._place_m if math.isfinite(self._placed_s) else None

    @property
    def booted_s(self) -> float:
        """When it booted, by CLOCK_BOOTTIME of this computer: from its last report of its position."""
        return self._boot_s

    @property
    def degrees(self) -> tuple[float, float] | None:
        """See the class."""
        return self._degrees if time.monotonic() - self._located_s < FRESH_S else None

    @property
    def yaw_rad(self) -> float | None:
        """See the class."""
        return self._yaw_rad if time.monotonic() - self._turned_s < FRESH_S else None

    @property
    def said(self) -> str:
        """Its mode, and its last text for people."""
        return f"mode {self.mode_name}" + (f", its last text: {self.texts.last}" if self.texts.last else "")

    def receive(self) -> None:
        """Take what has come. Damaged frames and those of other systems are ignored."""
        for frame in self.link.receive():
            if not is_intact(frame):
                continue
            message = head(frame)
            who, payload = (message.system, message.component), message.payload.ljust(_WIDEST, b"\0")
            if message.kind == HEARTBEAT:
                self._take_heartbeat(who, payload)
            elif who == self._who and message.kind in self._takers:
                self._takers[message.kind](payload)

    def _take_heartbeat(self, who: tuple[int, int], payload: bytes) -> None:
        mode, vehicle, autopilot, base, status = struct.unpack_from("<IBBBB", payload)
        if autopilot == NO_AUTOPILOT or self._who not in (None, who):
            return
        self._who, self._heard_s, self.mode = who, time.monotonic(), mode
        self.armed, self.failsafe, self.family = bool(base & _ARMED), status == _CRITICAL, (autopilot, vehicle)
        self.dialect = next((dialect for dialect in _DIALECTS if dialect.speaks(autopilot, vehicle)), None)

    def _take_place(self, payload: bytes) -> None:
        boot_ms, *values = _FLOATS.unpack_from(payload)
        if all(map(math.isfinite, values)):
            self._place_m, self._placed_s = (values[0], values[1], values[2]), time.monotonic()
            self._boot_s = time.clock_gettime(time.CLOCK_BOOTTIME) - boot_ms / 1e3
            self.speed_m_s = math.hypot(*values[3:])

    def _take_degrees(self, payload: bytes) -> None:
        """Take GLOBAL_POSITION_INT; ArduPilot sends zeros where it does not know its position."""
        latitude, longitude = struct.unpack_from("<ii", payload, 4)
        if (latitude or longitude) and abs(latitude) <= 90e7 and abs(longitude) <= 180e7:
            self._degrees, self._located_s = (latitude / 1e7, longitude / 1e7), time.monotonic()

    def _take_attitude(self, payload: bytes) -> None:
        yaw_rad = _FLOATS.unpack_from(payload)[3]
        if math.isfinite(yaw_rad):
            self._yaw_rad, self._turned_s = yaw_rad, time.monotonic()

    def _take_answer(self, payload: bytes) -> None:
        """Keep a final result that is addressed to this program, or to all (MAVLink 1 has no address in it)."""
        command, result, _, _, *target = _ANSWER.unpack_from(payload)
        ours = all(number in (0, own) for number, own in zip(target, self._own))
        if ours and result != IN_PROGRESS:
            self.answers[command] = result

    def _take_status(self, payload: bytes) -> None:
        present, enabled, health, *_, left = _STATUS.unpack_from(payload)
        charge = left / 100 if left >= 0 else None
        self.status = SystemStatus(present & enabled & ~health, charge, time.monotonic())

    def _take_estimate(self, payload: bytes, form: str) -> None:
        (self.estimate,) = struct.unpack_from(form, payload)

    def _take_parameter(self, payload: bytes) -> None:
        (value,) = struct.unpack_from("<f", payload)
        name = printable(payload[8 : 8 + _NAME_BYTES].split(b"\0")[0].decode("ascii", "replace"))
        if math.isfinite(value):
            self.parameters[name] = value

    def beat(self) -> None:
        """Send a heartbeat."""
        self.link.send(self._writer.heartbeat(_ONBOARD))

    def request_stream(self, kind: int, rate_hz: float) -> None:
        """Request a message at a rate, for as long as the link is open; 0 Hz ends the request."""
        self.command(SET_MESSAGE_INTERVAL, kind, 1e6 / rate_hz if rate_hz else 0)

    def stream_hz(self, kind: int) -> float:
        """Return the rate at which a requested message arrived lately, in messages a second; 0 if unknown."""
        rate = self.link.messages.get(kind)
        return rate.hz if rate else 0.0

    def ask_once(self, kind: int) -> None:
        """Request a message once."""
        self.command(REQUEST, kind)

    def ask_parameter(self, name: str) -> None:
        """Request a parameter; `parameters` will have it, if there is one."""
        if self._who is not None:
            named = name.encode("ascii").ljust(_NAME_BYTES, b"\0")
            self._send(PARAM_REQUEST_READ, struct.pack("<hBB16s", -1, *self._who, named))

    def command(self, command: float, *parameters: float) -> None:
        """Send a command; `answers` will have its result."""
        if self._who is not None:
            self.link.send(self._writer.command(self._who, int(command), *parameters))

    def lead(self, place_m: tuple[float, float, float], yaw_rad: float) -> None:
        """Send a set-point: a position in LOCAL_POSITION_NED and a direction of the nose, from north to east."""
        if self._who is not None:
            now_ms = int(time.monotonic() * 1e3) & 0xFFFFFFFF
            values = (now_ms, *place_m, *(0.0,) * 6, yaw_rad, 0.0)
            self._send(SET_POINT, struct.pack("<I11fHBBB", *values, _PLACE_AND_YAW, *self._who, _LOCAL_NED))

    def _send(self, kind: int, payload: bytes) -> None:
        self.link.send(self._writer.frame(kind, payload))
