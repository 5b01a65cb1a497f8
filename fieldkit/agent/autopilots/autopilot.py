"""State of a drone's autopilot and commands to it over MAVLink, for programs on the drone's computer.

Messages, commands and their numbers are defined in https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import math
import struct
import time
from dataclasses import dataclass
from typing import Callable, Sequence

from fieldkit.agent.autopilots.arducopter import ArduCopter
from fieldkit.agent.autopilots.dialect import REQUEST, FlightDialect
from fieldkit.agent.autopilots.mavlink_frames import (
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
    is_intact,
    parse_frame,
)
from fieldkit.agent.autopilots.mavlink_links import FlightLink
from fieldkit.agent.autopilots.px4 import Px4
from fieldkit.agent.flying.reports import AutopilotTexts, printable

FRESH_S = 2.0
"""Maximum age of a report that describes the current state."""
PILOT, GUARD, PREFLIGHT = 191, 192, 193
"""Component ids of fieldkit's programs: the pilot, which flies a drone; the guard, which lands it if the pilot stops;
and the preflight check. They are MAV_COMP_ID_ONBOARD_COMPUTER and the next two ids."""

_DIALECTS: Sequence[FlightDialect] = (Px4(), ArduCopter())
_TIME_AND_FLOATS = struct.Struct("<I6f")
_STATUS = struct.Struct("<IIIHHhHHHHHHb")
_COMMAND_ACK = struct.Struct("<HBBiBB")
"""COMMAND_ACK: command, result, progress, result_param2, target_system, target_component; the last four are
extensions of MAVLink 2."""
_ARMED = 0x80
_CRITICAL = 5
"""MAV_STATE_CRITICAL: PX4 (HEARTBEAT.hpp) and ArduPilot report it while a failsafe is active."""
_LOCAL_NED = 1
"""MAV_FRAME_LOCAL_NED."""
_POSITION_AND_YAW = 0b100111111000
"""POSITION_TARGET_TYPEMASK: position and yaw are used; velocity, acceleration and yaw rate are ignored."""
_OWN_SYSTEM = 245
"""System id of fieldkit's programs, near the end of the range, as is usual for ground stations and tools
(https://mavlink.io/en/guide/routing.html)."""
_TYPE_ONBOARD = 18
"""MAV_TYPE_ONBOARD_CONTROLLER."""
_MAX_PAYLOAD_BYTES = 255
_NAME_BYTES = 16
"""Length of the field with the name of a parameter."""


@dataclass(frozen=True)
class SystemStatus:
    """Content of SYS_STATUS.

    Attributes:
        unhealthy: Bits of the sensors that are present, enabled and not healthy (MAV_SYS_STATUS_SENSOR).
        charge: Remaining charge of the battery, from 0 to 1; None if unknown.
        received_s: Time of arrival by the monotonic clock.
    """

    unhealthy: int
    charge: float | None
    received_s: float


class AutopilotCommands:
    """Sends commands and requests to an autopilot.

    Until the first heartbeat of the autopilot arrives, it sends only the heartbeats of this program.

    Args:
        link: The connection.
        component: Component id of this program.

    Attributes:
        target: System id and component id of the autopilot; None before its first heartbeat.
    """

    def __init__(self, link: FlightLink, component: int) -> None:
        self.target: tuple[int, int] | None = None
        self._link = link
        self._writer = FrameWriter(_OWN_SYSTEM, component)

    def send_heartbeat(self) -> None:
        """Send a heartbeat."""
        self._link.send(self._writer.heartbeat(_TYPE_ONBOARD))

    def request_stream(self, kind: int, rate_hz: float) -> None:
        """Request a message at this rate while the link is open; 0 Hz cancels the request."""
        self.send(SET_MESSAGE_INTERVAL, kind, 1e6 / rate_hz if rate_hz else 0)

    def request_once(self, kind: int) -> None:
        """Request a message once."""
        self.send(REQUEST, kind)

    def request_parameter(self, name: str) -> None:
        """Request a parameter; its value is added to `AutopilotState.parameters` if it exists."""
        if self.target is not None:
            padded_name = name.encode("ascii").ljust(_NAME_BYTES, b"\0")
            self._send_frame(PARAM_REQUEST_READ, struct.pack("<hBB16s", -1, *self.target, padded_name))

    def send(self, command: float, *parameters: float) -> None:
        """Send a command; its result is stored in `AutopilotState.command_results`."""
        if self.target is not None:
            self._link.send(self._writer.command(self.target, int(command), *parameters))

    def send_set_point(self, position_m: tuple[float, float, float], yaw_rad: float) -> None:
        """Send a set-point: a position in LOCAL_POSITION_NED, and a heading clockwise from north."""
        if self.target is not None:
            now_ms = int(time.monotonic() * 1e3) & 0xFFFFFFFF
            values = (now_ms, *position_m, *(0.0,) * 6, yaw_rad, 0.0)
            self._send_frame(
                SET_POINT, struct.pack("<I11fHBBB", *values, _POSITION_AND_YAW, *self.target, _LOCAL_NED)
            )

    def _send_frame(self, kind: int, payload: bytes) -> None:
        self._link.send(self._writer.frame(kind, payload))


class AutopilotState:
    """The reported state of an autopilot.

    Args:
        link: The connection; the first autopilot whose heartbeat arrives there is used.
        component: Component id of this program.

    Attributes:
        link: The connection.
        commands: Sends commands to the autopilot.
        armed: Whether its motors may turn; False before its first heartbeat.
        failsafe: Whether one of its failsafes is active; False before its first heartbeat.
        mode: Its custom mode, from its last heartbeat; 0 before the first.
        dialect: The dialect of its family; None for an unknown family, or before its first heartbeat.
        family: Its MAV_AUTOPILOT and MAV_TYPE; `NO_AUTOPILOT` and 0 before its first heartbeat.
        speed_m_s: Its speed in three dimensions, from its last position report; 0 before the first.
        boot_time_s: Its boot time by CLOCK_BOOTTIME of this computer, from its last position report; 0 before the
            first.
        status: Its health and battery; None before its first report.
        estimate: Flags of its position estimate (ESTIMATOR_STATUS_FLAGS); None before its first report.
        has_home: Whether it has reported its home position.
        parameters: The values of the requested parameters that it has reported.
        texts: Its last text messages (STATUSTEXT).
        command_results: The final MAV_RESULT of each command, from its last acknowledgement.
    """

    def __init__(self, link: FlightLink, component: int = PILOT) -> None:
        self.link = link
        self._component = component
        self.commands = AutopilotCommands(link, component)
        self._heartbeat_s = self._position_s = self._attitude_s = self._latitude_longitude_s = -math.inf
        self._position_m = (0.0, 0.0, 0.0)
        self._latitude_longitude = (0.0, 0.0)
        self._yaw_rad = self.speed_m_s = self.boot_time_s = 0.0
        self.mode = 0
        self.armed = self.failsafe = self.has_home = False
        self.dialect: FlightDialect | None = None
        self.family = (NO_AUTOPILOT, 0)
        self.status: SystemStatus | None = None
        self.estimate: int | None = None
        self.parameters: dict[str, float] = {}
        self.texts = AutopilotTexts()
        self.command_results: dict[int, int] = {}
        self._handlers: dict[int, Callable[[bytes], None]] = {
            LOCAL_POSITION_NED: self._on_position,
            GLOBAL_POSITION_INT: self._on_global_position,
            ATTITUDE: self._on_attitude,
            COMMAND_ACK: self._on_command_ack,
            STATUSTEXT: self.texts.add_message,
            SYS_STATUS: self._on_status,
            # The flags follow 40 bytes in ESTIMATOR_STATUS, and 20 bytes in EKF_STATUS_REPORT.
            ESTIMATOR_STATUS: lambda payload: self._on_estimate(payload, "<40xH"),
            EKF_STATUS_REPORT: lambda payload: self._on_estimate(payload, "<20xH"),
            HOME_POSITION: lambda _: setattr(self, "has_home", True),
            PARAM_VALUE: self._on_parameter,
        }

    @property
    def alive(self) -> bool:
        """Whether its last heartbeat is less than `2 * FRESH_S` old."""
        return self.heartbeat_age_s < 2 * FRESH_S

    @property
    def system(self) -> int:
        """Its system id; 0 before its first heartbeat."""
        return self.commands.target[0] if self.commands.target else 0

    @property
    def heartbeat_age_s(self) -> float:
        """Time since its last heartbeat; infinite before the first."""
        return time.monotonic() - self._heartbeat_s

    @property
    def guided(self) -> bool:
        """Whether it follows set-points in its mode."""
        return self.dialect is not None and self.dialect.is_guided(self.mode)

    @property
    def lands_or_returns(self) -> bool:
        """Whether it lands, or returns and lands, automatically in its mode."""
        return self.dialect is not None and self.dialect.lands_or_returns(self.mode)

    @property
    def mode_name(self) -> str:
        """The documented name of its mode, or its number if the mode is unknown."""
        return self.dialect.mode_name(self.mode) if self.dialect else str(self.mode)

    @property
    def position_m(self) -> tuple[float, float, float] | None:
        """Position north, east, down in LOCAL_POSITION_NED; None without a fresh report."""
        return self._position_m if self.position_age_s < FRESH_S else None

    @property
    def position_age_s(self) -> float:
        """Time since its last report of its position; infinite before the first."""
        return time.monotonic() - self._position_s

    @property
    def last_position_m(self) -> tuple[float, float, float] | None:
        """Its last reported position of any age; None before the first."""
        return self._position_m if math.isfinite(self._position_s) else None

    @property
    def latitude_longitude(self) -> tuple[float, float] | None:
        """Latitude and longitude in degrees; None without a fresh report that contains them."""
        return self._latitude_longitude if time.monotonic() - self._latitude_longitude_s < FRESH_S else None

    @property
    def yaw_rad(self) -> float | None:
        """Its heading, clockwise from north; None without a fresh report."""
        return self._yaw_rad if time.monotonic() - self._attitude_s < FRESH_S else None

    def receive(self) -> None:
        """Process frames that have arrived. Damaged frames and frames of other senders are ignored."""
        for frame in self.link.receive():
            if not is_intact(frame):
                continue
            message = parse_frame(frame)
            source, payload = (message.system, message.component), message.payload.ljust(_MAX_PAYLOAD_BYTES, b"\0")
            if message.kind == HEARTBEAT:
                self._on_heartbeat(source, payload)
            elif source == self.commands.target and message.kind in self._handlers:
                self._handlers[message.kind](payload)

    def _on_heartbeat(self, source: tuple[int, int], payload: bytes) -> None:
        mode, vehicle, autopilot, base, status = struct.unpack_from("<IBBBB", payload)
        if autopilot == NO_AUTOPILOT or self.commands.target not in (None, source):
            return
        self.commands.target, self._heartbeat_s, self.mode = source, time.monotonic(), mode
        self.armed, self.failsafe, self.family = bool(base & _ARMED), status == _CRITICAL, (autopilot, vehicle)
        self.dialect = next((dialect for dialect in _DIALECTS if dialect.matches(autopilot, vehicle)), None)

    def _on_position(self, payload: bytes) -> None:
        boot_ms, *values = _TIME_AND_FLOATS.unpack_from(payload)
        if all(map(math.isfinite, values)):
            self._position_m, self._position_s = (values[0], values[1], values[2]), time.monotonic()
            self.boot_time_s = time.clock_gettime(time.CLOCK_BOOTTIME) - boot_ms / 1e3
            self.speed_m_s = math.hypot(*values[3:])

    def _on_global_position(self, payload: bytes) -> None:
        """Process GLOBAL_POSITION_INT, in 1e-7 degrees. ArduPilot sends two zeros if its position is unknown."""
        latitude, longitude = struct.unpack_from("<ii", payload, 4)
        if (latitude or longitude) and abs(latitude) <= 90e7 and abs(longitude) <= 180e7:
            self._latitude_longitude, self._latitude_longitude_s = (latitude / 1e7, longitude / 1e7), time.monotonic()

    def _on_attitude(self, payload: bytes) -> None:
        yaw_rad = _TIME_AND_FLOATS.unpack_from(payload)[3]
        if math.isfinite(yaw_rad):
            self._yaw_rad, self._attitude_s = yaw_rad, time.monotonic()

    def _on_command_ack(self, payload: bytes) -> None:
        """Store a final result for this program or for all programs (COMMAND_ACK of MAVLink 1 has no target)."""
        command, result, _, _, *target = _COMMAND_ACK.unpack_from(payload)
        is_for_this_program = all(
            number in (0, own_number) for number, own_number in zip(target, (_OWN_SYSTEM, self._component))
        )
        if is_for_this_program and result != IN_PROGRESS:
            self.command_results[command] = result

    def _on_status(self, payload: bytes) -> None:
        present, enabled, health, *_, remaining_percent = _STATUS.unpack_from(payload)
        charge = remaining_percent / 100 if remaining_percent >= 0 else None
        self.status = SystemStatus(present & enabled & ~health, charge, time.monotonic())

    def _on_estimate(self, payload: bytes, layout: str) -> None:
        (self.estimate,) = struct.unpack_from(layout, payload)

    def _on_parameter(self, payload: bytes) -> None:
        (value,) = struct.unpack_from("<f", payload)
        name = printable(payload[8 : 8 + _NAME_BYTES].split(b"\0")[0].decode("ascii", "replace"))
        if math.isfinite(value):
            self.parameters[name] = value


def status_text(drone: AutopilotState) -> str:
    """Return a text with the mode of an autopilot, and with its last text message if it has sent one."""
    return f"mode {drone.mode_name}" + (f", its last text: {drone.texts.last_text}" if drone.texts.last_text else "")
