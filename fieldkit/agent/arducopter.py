"""ArduCopter, as a program that flies a drone sees it (ArduPilot's other vehicles have other modes)."""

from __future__ import annotations

from typing import Mapping, Sequence

from fieldkit.agent.dialect import CHANGE_SPEED, CUSTOM_MODE, SET_MODE, TAKE_OFF, AutopilotBounds, Command
from fieldkit.agent.mavlink_frames import EKF_STATUS_REPORT

_ARDUPILOT = 3
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
"""Its modes by their numbers (ArduCopter/mode.h; https://ardupilot.org/copter/docs/parameters.html#fltmode1)."""
_CLIMB_SPEED = 2
_FENCE_TOP, _FENCE_CIRCLE = 1, 2


class ArduCopter:
    """See `FlightDialect`. On the ground it ignores set-points: it takes off by command, and follows them then.

    In GUIDED it holds the last position without any time limit (GUID_TIMEOUT is for velocities).
    """

    name = "ArduCopter"
    guided = "GUIDED"
    estimate = EKF_STATUS_REPORT
    bounds_from: Sequence[str] = ("FENCE_ENABLE", "FENCE_TYPE", "FENCE_ALT_MAX", "FENCE_RADIUS", "RTL_ALT|RTL_ALT_M")
    says_now = False

    def speaks(self, autopilot: int, vehicle: int) -> bool:
        """See `FlightDialect.speaks`."""
        return autopilot == _ARDUPILOT and vehicle in _COPTERS

    def is_guided(self, mode: int) -> bool:
        """See `FlightDialect.is_guided`."""
        return mode == _GUIDED

    def is_led(self, mode: int) -> bool:
        """See `FlightDialect.is_led`: in LOITER and the others a person flies it."""
        return mode in (_AUTO, _GUIDED)

    def comes_down(self, mode: int) -> bool:
        """See `FlightDialect.comes_down`."""
        return mode in (_RTL, _LAND, _SMART_RTL, _AUTO_RTL)

    def waits(self, mode: int) -> bool:  # noqa: ARG002
        """See `FlightDialect.waits`: it stays in GUIDED."""
        return False

    def mode_name(self, mode: int) -> str:
        """See `FlightDialect.mode_name`."""
        return _MODES.get(mode, str(mode))

    def guide(self) -> Command:
        """See `FlightDialect.guide`."""
        return (SET_MODE, CUSTOM_MODE, _GUIDED)

    def take_off(self, height_m: float, climb_m_s: float) -> Sequence[Command]:
        """See `FlightDialect.take_off`; before 4.1 it climbs as fast as WPNAV_SPEED_UP says."""
        return (CHANGE_SPEED, _CLIMB_SPEED, climb_m_s), (TAKE_OFF, 0, 0, 0, 0, 0, 0, height_m)

    def bring_down(self, how: str) -> Command:
        """See `FlightDialect.bring_down`."""
        return (SET_MODE, CUSTOM_MODE, _RTL if how == "return" else _LAND)

    def bounds(self, values: Mapping[str, float]) -> AutopilotBounds:
        """See `FlightDialect.bounds`; RTL_ALT is in cm, and RTL_ALT_M took its place in 4.7."""
        fences = int(values.get("FENCE_TYPE", 0)) if values.get("FENCE_ENABLE") else 0
        back_m = values["RTL_ALT"] / 100 if "RTL_ALT" in values else values.get("RTL_ALT_M")
        return AutopilotBounds(
            height_m=values.get("FENCE_ALT_MAX") if fences & _FENCE_TOP else None,
            radius_m=values.get("FENCE_RADIUS") if fences & _FENCE_CIRCLE else None,
            return_m=back_m,
        )
