"""Executes the commands COMMAND_LONG and COMMAND_INT to the vehicle, and returns their MAV_RESULT."""

import math
from collections.abc import Callable
from typing import Final

from sim_backends.emulated.autopilot.mavlink_frames import Message, dialect
from sim_backends.emulated.autopilot.mission_plan import goal_m
from sim_backends.emulated.autopilot.modes import Mode
from sim_backends.emulated.autopilot.parameters import Parameters
from sim_backends.emulated.autopilot.vehicle import Refused, Vehicle

FORCE: Final = 21196
"""Value of the second parameter of MAV_CMD_COMPONENT_ARM_DISARM that stops the motors even in the air."""

_FRAME_RELATIVE: Final = dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT

_ACCEPTED: Final = int(dialect.MAV_RESULT_ACCEPTED)
_DENIED: Final = int(dialect.MAV_RESULT_DENIED)
_UNSUPPORTED_FRAME: Final = 9
"""MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME of MAVLink's common.xml, which pymavlink 2.4 lacks."""


class Commands:
    """Executes commands.

    Args:
        vehicle: The vehicle.
        parameters: Its parameters, which some commands change.
    """

    def __init__(self, vehicle: Vehicle, parameters: Parameters) -> None:
        self._vehicle = vehicle
        self._parameters = parameters
        self._handlers: Final[dict[int, Callable[[Message], int]]] = {
            dialect.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            dialect.MAV_CMD_RUN_PREARM_CHECKS: self._check,
            dialect.MAV_CMD_NAV_TAKEOFF: self._take_off,
            dialect.MAV_CMD_NAV_LAND: lambda _: self._change_mode(Mode.LAND),
            dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._change_mode(Mode.RTL),
            dialect.MAV_CMD_MISSION_START: self._start,
            dialect.MAV_CMD_DO_SET_MODE: self._set_mode,
            dialect.MAV_CMD_DO_REPOSITION: self._reposition,
            dialect.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            dialect.MAV_CMD_DO_SET_MISSION_CURRENT: self._set_current,
            dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
        }

    def run(self, message: Message) -> int:
        """Execute the command in a COMMAND_LONG or COMMAND_INT; return its MAV_RESULT.

        The reason for a refusal is added to the vehicle's status texts, if the firmware sends one.
        """
        handler = self._handlers.get(message.command)
        if handler is None:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        try:
            return handler(message)
        except Refused as refusal:
            self._report_refusal(refusal)
            return self._vehicle.firmware.refusal_result

    def set_mode(self, custom_mode: int) -> None:
        """Execute SET_MODE, which has no answer."""
        try:
            self._change_custom_mode(custom_mode)
        except Refused as refusal:
            self._report_refusal(refusal)

    def _report_refusal(self, refusal: Refused) -> None:
        if str(refusal):
            is_ardupilot = self._vehicle.firmware.is_ardupilot
            severity = dialect.MAV_SEVERITY_WARNING if is_ardupilot else dialect.MAV_SEVERITY_CRITICAL
            self._vehicle.report(severity, str(refusal))

    def _check(self, _: Message) -> int:
        self._vehicle.check()
        return _ACCEPTED

    def _arm(self, message: Message) -> int:
        if message.param1 not in {0, 1}:
            return _DENIED
        if message.param1:
            self._vehicle.arm()
        else:
            self._vehicle.disarm(force=message.param2 == FORCE)
        return _ACCEPTED

    def _take_off(self, message: Message) -> int:
        """Take off. NaN or 0 means the default height. In COMMAND_LONG, the height is relative to home."""
        height_m, home_m = _seventh_parameter(message), self._vehicle.home_m
        if not math.isfinite(height_m) or height_m == 0:
            self._vehicle.take_off()
            return _ACCEPTED
        frame = getattr(message, "frame", _FRAME_RELATIVE)
        goal = goal_m(frame, 0, 0, height_m, home_m)
        if goal is None:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        self._vehicle.take_off(goal[2])
        return _ACCEPTED

    def _change_mode(self, mode: Mode) -> int:
        self._vehicle.change_mode(mode)
        return _ACCEPTED

    def _start(self, message: Message) -> int:
        if message.param1 > 0 and not self._select_item(message.param1):
            return _DENIED
        return self._change_mode(Mode.MISSION)

    def _set_mode(self, message: Message) -> int:
        """Execute MAV_CMD_DO_SET_MODE."""
        if (
            not is_integer_up_to(message.param1, 255)
            or not int(message.param1) & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        ):
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        if not is_integer_up_to(message.param2, 255) or not is_integer_up_to(message.param3, 255):
            return _DENIED
        number, sub = int(message.param2), int(message.param3)
        if self._vehicle.firmware.autopilot == dialect.MAV_AUTOPILOT_PX4:
            number = number << 16 | sub << 24  # main mode and sub mode, as in `custom_mode` of HEARTBEAT
        return _ACCEPTED if self._change_custom_mode(number) else self._vehicle.firmware.unknown_mode

    def _change_custom_mode(self, custom_mode: int) -> bool:
        """Change to the mode with this number; return True if the firmware has such a mode."""
        mode = self._vehicle.firmware.mode_of(custom_mode)
        if mode is not None:
            self._vehicle.change_mode(mode)
        elif self._vehicle.firmware.is_ardupilot:
            self._vehicle.report(dialect.MAV_SEVERITY_WARNING, f"No such mode {custom_mode}")
        return mode is not None

    def _reboot(self, message: Message) -> int:
        """Reboot (param1 is 1); refused while armed."""
        if message.param1 != 1:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        if self._vehicle.is_armed:
            return self._vehicle.firmware.refusal_result
        self._vehicle.boot(self._vehicle.body.now_ns)
        return _ACCEPTED

    def _reposition(self, message: Message) -> int:
        """Fly to a position (MAV_CMD_DO_REPOSITION).

        NaN keeps the altitude; the largest integer, as latitude or longitude, keeps both of them.
        """
        if message.get_type() != "COMMAND_INT":
            return int(dialect.MAV_RESULT_COMMAND_INT_ONLY)
        here_m = self._vehicle.body.position_m
        keeps_altitude = not math.isfinite(message.z)
        z_m = 0.0 if keeps_altitude else message.z
        goal = goal_m(message.frame, message.x, message.y, z_m, self._vehicle.home_m)
        if goal is None:
            return _UNSUPPORTED_FRAME
        if keeps_altitude:
            goal = (*goal[:2], here_m[2])
        if _CURRENT_COORDINATE in {message.x, message.y}:
            goal = (*here_m[:2], goal[2])
        self._vehicle.go_to(goal)
        return _ACCEPTED

    def _change_speed(self, message: Message) -> int:
        key = _SPEEDS.get(message.param1, "MPC_XY_VEL_MAX")
        return _ACCEPTED if self._parameters.change(key, message.param2) else _DENIED

    def _set_current(self, message: Message) -> int:
        return _ACCEPTED if self._select_item(message.param1) else _DENIED

    def _select_item(self, number: float) -> bool:
        """Make the item with this number the current item; return True if there is such an item."""
        mission = self._vehicle.mission
        if not is_integer_up_to(number, len(mission.items) - 1):
            return False
        mission.set_current(int(number))
        return True


_SPEEDS: Final = {2: "MPC_Z_VEL_MAX_UP", 3: "MPC_Z_VEL_MAX_DN"}
"""Parameter that MAV_CMD_DO_CHANGE_SPEED sets, by SPEED_TYPE; other types set the ground speed."""
_CURRENT_COORDINATE: Final = 0x7FFFFFFF
"""Value of a coordinate (INT32_MAX) that keeps the current position."""


def is_integer_up_to(value: float, maximum: int) -> bool:
    """Return True if the value of a float field, which may be NaN, is an integer from 0 to `maximum`."""
    return math.isfinite(value) and value == int(value) and 0 <= value <= maximum


def _seventh_parameter(message: Message) -> float:
    """Return the seventh parameter of a command, which is named `z` in COMMAND_INT."""
    return float(message.z if message.get_type() == "COMMAND_INT" else message.param7)
