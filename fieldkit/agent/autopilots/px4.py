"""Flight dialect of PX4: its modes, commands and parameters."""

from __future__ import annotations

from typing import Mapping, Sequence

from fieldkit.agent.autopilots.dialect import CUSTOM_MODE, LAND, RETURN, SET_MODE, AutopilotLimits, Command
from fieldkit.agent.autopilots.mavlink_frames import ESTIMATOR_STATUS

_PX4 = 12
"""MAV_AUTOPILOT_PX4."""
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
"""Main modes (`_MAIN`, bits 16 to 23 of a custom mode), and sub-modes of AUTO (`_SUB`, bits 24 to 31); see
px4_custom_mode.h of PX4."""


class Px4:
    """Dialect of PX4.

    In OFFBOARD, an armed PX4 takes off if its set-point (target position) is above the ground. If set-points are
    missing for COM_OF_LOSS_T, it changes to the mode that COM_OBL_RC_ACT selects.
    """

    name = "PX4"
    guided_mode = "OFFBOARD"
    estimate_message = ESTIMATOR_STATUS
    limit_parameters: Sequence[str] = ("GF_MAX_VER_DIST", "GF_MAX_HOR_DIST", "RTL_RETURN_ALT")
    checks_current_mode = True

    def matches(self, autopilot: int, vehicle: int) -> bool:  # noqa: ARG002 (all vehicles have the same modes)
        """Return True if the autopilot is PX4, on any vehicle."""
        return autopilot == _PX4

    def is_guided(self, mode: int) -> bool:
        """Return True in OFFBOARD, the mode in which PX4 follows set-points."""
        return _mode_parts(mode)[0] == _OFFBOARD

    def is_program_controlled(self, mode: int) -> bool:
        """Return True in OFFBOARD, AUTO.TAKEOFF, AUTO.MISSION and AUTO.LOITER.

        PX4 selects AUTO.LOITER after a commanded take-off, and to fly to a commanded position.
        """
        main, sub = _mode_parts(mode)
        return main == _OFFBOARD or (main == _AUTO and sub in (_TAKEOFF, _LOITER, _MISSION))

    def lands_or_returns(self, mode: int) -> bool:
        """Return True in the modes in which the drone lands automatically: AUTO.RTL, AUTO.LAND and AUTO.PRECLAND."""
        main, sub = _mode_parts(mode)
        return main == _AUTO and sub in (_RTL, _LAND, _PRECLAND)

    def is_failsafe_hold(self, mode: int) -> bool:
        """Return True in AUTO.LOITER.

        PX4 uses this mode if set-points are missing and COM_OBL_RC_ACT selects Hold or, depending on the version, a
        mode that needs a remote control although none is connected. It also precedes other failsafe actions for the
        time COM_FAIL_ACT_T.
        """
        return _mode_parts(mode) == (_AUTO, _LOITER)

    def mode_name(self, mode: int) -> str:
        """Return the name of a mode, for example `AUTO.LAND`, or its number if the main mode is unknown.

        An unknown sub-mode of AUTO has its number in the name: `AUTO.13`.
        """
        main, sub = _mode_parts(mode)
        if main not in _MAIN:
            return str(mode)
        return f"AUTO.{_SUB.get(sub, sub)}" if main == _AUTO else _MAIN[main]

    def guided_command(self) -> Command:
        """Return the command that selects OFFBOARD."""
        return (SET_MODE, CUSTOM_MODE, _OFFBOARD)

    def take_off_commands(self, height_m: float, climb_m_s: float) -> Sequence[Command]:  # noqa: ARG002
        """Return no commands: PX4 takes off when a set-point is above the ground."""
        return ()

    def bring_down_command(self, action: str) -> Command:
        """Return the command to return or to land."""
        return (RETURN,) if action == "return" else (LAND,)

    def limits(self, values: Mapping[str, float]) -> AutopilotLimits:
        """Return the limits; a value of 0 means no fence (PX4 parameter reference, Geofence)."""
        return AutopilotLimits(
            height_m=values.get("GF_MAX_VER_DIST") or None,
            radius_m=values.get("GF_MAX_HOR_DIST") or None,
            return_m=values.get("RTL_RETURN_ALT"),
        )


def _mode_parts(mode: int) -> tuple[int, int]:
    """Return the main mode and the sub-mode of a custom mode."""
    return mode >> 16 & 0xFF, mode >> 24 & 0xFF
