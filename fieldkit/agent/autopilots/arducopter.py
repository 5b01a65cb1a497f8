"""Flight dialect of ArduCopter: its modes, commands and parameters. ArduPilot's other vehicles have other modes."""

from __future__ import annotations

from typing import Mapping, Sequence

from fieldkit.agent.autopilots.dialect import CHANGE_SPEED, CUSTOM_MODE, SET_MODE, TAKE_OFF, AutopilotLimits, Command
from fieldkit.agent.autopilots.mavlink_frames import EKF_STATUS_REPORT

_ARDUPILOT = 3
"""MAV_AUTOPILOT_ARDUPILOTMEGA."""
_COPTERS = frozenset((2, 3, 4, 13, 14, 15, 29, 35))
"""MAV_TYPE: quadrotor, coaxial, helicopter, hexarotor, octorotor, tricopter, dodecarotor, decarotor."""
_AUTO, _GUIDED, _RTL, _LAND, _SMART_RTL, _AUTO_RTL = 3, 4, 6, 9, 21, 27
_MODES = {
    0: "STABILIZE",
    1: "ACRO",
    2: "ALT_HOLD",
    _AUTO: "AUTO",
    _GUIDED: "GUIDED",
    5: "LOITER",
    _RTL: "RTL",
    7: "CIRCLE",
    _LAND: "LAND",
    11: "DRIFT",
    13: "SPORT",
    14: "FLIP",
    15: "AUTOTUNE",
    16: "POSHOLD",
    17: "BRAKE",
    18: "THROW",
    19: "AVOID_ADSB",
    20: "GUIDED_NOGPS",
    _SMART_RTL: "SMART_RTL",
    22: "FLOWHOLD",
    23: "FOLLOW",
    24: "ZIGZAG",
    25: "SYSTEMID",
    26: "AUTOROTATE",
    _AUTO_RTL: "AUTO_RTL",
    28: "TURTLE",
}
"""Names of the modes by number (ArduCopter/mode.h; https://ardupilot.org/copter/docs/parameters.html#fltmode1)."""
_CLIMB_SPEED = 2
"""SPEED_TYPE_CLIMB_SPEED."""
_FENCE_TOP, _FENCE_CIRCLE = 1, 2
"""Bits of the parameter FENCE_TYPE: maximum altitude, and a circle around home."""


class ArduCopter:
    """Dialect of ArduCopter.

    On the ground, ArduCopter ignores set-points (target positions). It takes off by command, and then follows
    set-points. If set-points are missing in GUIDED, it flies to the last one and holds it without a time limit
    (GUID_TIMEOUT does not apply to positions).
    """

    name = "ArduCopter"
    guided_mode = "GUIDED"
    estimate_message = EKF_STATUS_REPORT
    limit_parameters: Sequence[str] = (
        "FENCE_ENABLE",
        "FENCE_TYPE",
        "FENCE_ALT_MAX",
        "FENCE_RADIUS",
        "RTL_ALT|RTL_ALT_M",
    )
    checks_current_mode = False

    def matches(self, autopilot: int, vehicle: int) -> bool:
        """Return True if the autopilot is ArduPilot and the vehicle is a multicopter or helicopter."""
        return autopilot == _ARDUPILOT and vehicle in _COPTERS

    def is_guided(self, mode: int) -> bool:
        """Return True in GUIDED, the mode in which ArduCopter follows set-points."""
        return mode == _GUIDED

    def is_program_controlled(self, mode: int) -> bool:
        """Return True in AUTO and GUIDED.

        LOITER is not included, because a person flies the drone in this mode (AUTO.LOITER of PX4 differs).
        """
        return mode in (_AUTO, _GUIDED)

    def lands_or_returns(self, mode: int) -> bool:
        """Return True in the modes in which the drone lands automatically: RTL, LAND, SMART_RTL and AUTO_RTL."""
        return mode in (_RTL, _LAND, _SMART_RTL, _AUTO_RTL)

    def is_failsafe_hold(self, mode: int) -> bool:  # noqa: ARG002
        """Return False, because ArduCopter stays in GUIDED if set-points are missing."""
        return False

    def mode_name(self, mode: int) -> str:
        """Return the name of a mode, or its number if the mode is unknown."""
        return _MODES.get(mode, str(mode))

    def guided_command(self) -> Command:
        """Return the command that selects GUIDED."""
        return (SET_MODE, CUSTOM_MODE, _GUIDED)

    def take_off_commands(self, height_m: float, climb_m_s: float) -> Sequence[Command]:
        """Return the commands for climb speed and take-off.

        ArduCopter before 4.1 ignores the climb speed of the command and uses its parameter WPNAV_SPEED_UP.
        """
        return (CHANGE_SPEED, _CLIMB_SPEED, climb_m_s), (TAKE_OFF, 0, 0, 0, 0, 0, 0, height_m)

    def bring_down_command(self, action: str) -> Command:
        """Return the command that selects RTL or LAND."""
        return (SET_MODE, CUSTOM_MODE, _RTL if action == "return" else _LAND)

    def limits(self, values: Mapping[str, float]) -> AutopilotLimits:
        """Return the limits. RTL_ALT is in cm; ArduCopter 4.7 replaced it by RTL_ALT_M, which is in m."""
        fences = int(values.get("FENCE_TYPE", 0)) if values.get("FENCE_ENABLE") else 0
        return_m = values["RTL_ALT"] / 100 if "RTL_ALT" in values else values.get("RTL_ALT_M")
        return AutopilotLimits(
            height_m=values.get("FENCE_ALT_MAX") if fences & _FENCE_TOP else None,
            radius_m=values.get("FENCE_RADIUS") if fences & _FENCE_CIRCLE else None,
            return_m=return_m,
        )
