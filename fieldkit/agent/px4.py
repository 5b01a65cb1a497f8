"""PX4, as a program that flies a drone sees it."""

from __future__ import annotations

from typing import Mapping, Sequence

from fieldkit.agent.dialect import CUSTOM_MODE, LAND, RETURN, SET_MODE, AutopilotBounds, Command
from fieldkit.agent.mavlink_frames import ESTIMATOR_STATUS

_PX4 = 12
_OFFBOARD, _AUTO = 6, 4
_TAKEOFF, _LOITER, _MISSION, _RTL, _LAND, _PRECLAND = 2, 3, 4, 5, 6, 9
_MAIN = {
    1: "MANUAL",
    2: "ALTCTL",
    3: "POSCTL",
    _AUTO: "AUTO",
    5: "ACRO",
    _OFFBOARD: "OFFBOARD",
    7: "STABILIZED",
    8: "RATTITUDE",
    10: "TERMINATION",
    11: "ALTITUDE_CRUISE",
}
_SUB = {
    1: "READY",
    _TAKEOFF: "TAKEOFF",
    _LOITER: "LOITER",
    _MISSION: "MISSION",
    _RTL: "RTL",
    _LAND: "LAND",
    8: "FOLLOW_TARGET",
    _PRECLAND: "PRECLAND",
    10: "VTOL_TAKEOFF",
}
"""Main modes, and sub-modes of AUTO: bytes 2 and 3 of a custom mode (PX4, px4_custom_mode.h)."""


class Px4:
    """See `FlightDialect`. It takes off by set-points, too, and holds without them (COM_OF_LOSS_T)."""

    name = "PX4"
    guided = "OFFBOARD"
    estimate = ESTIMATOR_STATUS
    bounds_from: Sequence[str] = ("GF_MAX_VER_DIST", "GF_MAX_HOR_DIST", "RTL_RETURN_ALT")
    says_now = True

    def speaks(self, autopilot: int, vehicle: int) -> bool:  # noqa: ARG002 (it flies all by the same modes)
        """See `FlightDialect.speaks`."""
        return autopilot == _PX4

    def is_guided(self, mode: int) -> bool:
        """See `FlightDialect.is_guided`."""
        return _parts(mode)[0] == _OFFBOARD

    def is_led(self, mode: int) -> bool:
        """See `FlightDialect.is_led`: AUTO.LOITER follows each take-off and each command to go somewhere."""
        main, sub = _parts(mode)
        return main == _OFFBOARD or (main == _AUTO and sub in (_TAKEOFF, _LOITER, _MISSION))

    def comes_down(self, mode: int) -> bool:
        """See `FlightDialect.comes_down`."""
        main, sub = _parts(mode)
        return main == _AUTO and sub in (_RTL, _LAND, _PRECLAND)

    def waits(self, mode: int) -> bool:
        """See `FlightDialect.waits`: it holds where no sticks are (COM_OBL_RC_ACT)."""
        return _parts(mode) == (_AUTO, _LOITER)

    def mode_name(self, mode: int) -> str:
        """See `FlightDialect.mode_name`: `AUTO.LAND`, for example."""
        main, sub = _parts(mode)
        if main not in _MAIN:
            return str(mode)
        return f"AUTO.{_SUB.get(sub, sub)}" if main == _AUTO else _MAIN[main]

    def guide(self) -> Command:
        """See `FlightDialect.guide`."""
        return (SET_MODE, CUSTOM_MODE, _OFFBOARD)

    def take_off(self, height_m: float, climb_m_s: float) -> Sequence[Command]:  # noqa: ARG002
        """See `FlightDialect.take_off`."""
        return ()

    def bring_down(self, how: str) -> Command:
        """See `FlightDialect.bring_down`."""
        return (RETURN,) if how == "return" else (LAND,)

    def bounds(self, values: Mapping[str, float]) -> AutopilotBounds:
        """See `FlightDialect.bounds`; 0 is no fence (parameter reference, Geofence)."""
        return AutopilotBounds(
            height_m=values.get("GF_MAX_VER_DIST") or None,
            radius_m=values.get("GF_MAX_HOR_DIST") or None,
            return_m=values.get("RTL_RETURN_ALT"),
        )


def _parts(mode: int) -> tuple[int, int]:
    """Return the main mode and the sub-mode of a custom mode."""
    return mode >> 16 & 0xFF, mode >> 24 & 0xFF
