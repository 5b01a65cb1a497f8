"""PX4, as a program that flies a drone sees it."""

from __future__ import annotations

from typing import Mapping, Sequence

from fieldkit.agent.dialect import CUSTOM_MODE, LAND, RETURN, SET_MODE, AutopilotBounds, Command
from fieldkit.agent.mavlink_frames import ESTIMATOR_STATUS

_PX4 = 12
_OFFBOARD = 6
"""Its main mode, in which it goes where set-points say (px4_custom_mode.h)."""


class Px4:
    """See `FlightDialect`. It rises, too, where set-points lead it, and holds without them (COM_OF_LOSS_T)."""

    name = "PX4"
    guided = "OFFBOARD"
    estimate = ESTIMATOR_STATUS
    bounds_from: Sequence[str] = ("GF_MAX_VER_DIST", "GF_MAX_HOR_DIST", "RTL_RETURN_ALT")
    says_now = True

    def speaks(self, autopilot: int, vehicle: int) -> bool:  # noqa: ARG002 (it flies all by the same modes)
        """See `FlightDialect.speaks`."""
        return autopilot == _PX4

    def is_guided(self, mode: int) -> bool:
        """See `FlightDialect.is_guided`: the third byte is the main mode."""
        return mode >> 16 & 0xFF == _OFFBOARD

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
