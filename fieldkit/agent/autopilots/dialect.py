"""Interface of a flight dialect: the modes, commands and parameters of one family of autopilots.

A set-point is a target position that a program sends repeatedly. An autopilot follows set-points only in one mode.

Commands and their numbers are defined in https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping, Protocol, Sequence, Tuple

RETURN, LAND, TAKE_OFF, SET_MODE, CHANGE_SPEED = 20, 21, 22, 176, 178
"""MAV_CMD: NAV_RETURN_TO_LAUNCH, NAV_LAND, NAV_TAKEOFF, DO_SET_MODE, DO_CHANGE_SPEED."""
ARM, PREARM_CHECKS, REQUEST = 400, 401, 512
"""MAV_CMD: COMPONENT_ARM_DISARM, RUN_PREARM_CHECKS, REQUEST_MESSAGE."""

CUSTOM_MODE = 1
"""MAV_MODE_FLAG_CUSTOM_MODE_ENABLED: the mode is a number that each family of autopilots defines."""

Command = Tuple[float, ...]
"""Number of a MAV_CMD, and its parameters; trailing parameters that are 0 are omitted."""


@dataclass(frozen=True)
class AutopilotLimits:
    """Limits that an autopilot enforces, in metres; None for a limit that it does not have or did not report.

    Attributes:
        height_m: Maximum height above home.
        radius_m: Maximum horizontal distance from home.
        return_m: Minimum height above home while the drone returns.
    """

    height_m: float | None = None
    radius_m: float | None = None
    return_m: float | None = None


class FlightDialect(Protocol):
    """Modes and commands of one family of autopilots.

    Attributes:
        name: Name of the family.
        guided_mode: Name of the mode in which the autopilot follows set-points.
        estimate_message: Id of the message with the flags of the position estimate.
        limit_parameters: Names of the parameters with the limits of the autopilot; `|` separates alternative names of
            one parameter. The last one contains the height of a return.
        checks_current_mode: Whether the result of the autopilot's arming checks depends on its current mode.
    """

    name: str
    guided_mode: str
    estimate_message: int
    limit_parameters: Sequence[str]
    checks_current_mode: bool

    def matches(self, autopilot: int, vehicle: int) -> bool:
        """Return True if an autopilot belongs to this family, by MAV_AUTOPILOT and MAV_TYPE of its heartbeat."""

    def is_guided(self, mode: int) -> bool:
        """Return True if the autopilot follows set-points in a mode (the custom mode of its heartbeat)."""

    def is_program_controlled(self, mode: int) -> bool:
        """Return True if set-points, a mission or commands control the drone in a mode, not a person."""

    def lands_or_returns(self, mode: int) -> bool:
        """Return True if the drone lands, or returns and lands, automatically in a mode."""

    def is_failsafe_hold(self, mode: int) -> bool:
        """Return True if a mode is the failsafe for missing set-points, which holds the position."""

    def mode_name(self, mode: int) -> str:
        """Return the name of a mode, or its number if the mode is unknown."""

    def guided_command(self) -> Command:
        """Return the command that selects `guided_mode`."""

    def take_off_commands(self, height_m: float, climb_m_s: float) -> Sequence[Command]:
        """Return the commands for the take-off of an armed drone; empty if set-points are enough."""

    def bring_down_command(self, action: str) -> Command:
        """Return the command to `land` at the current position, or to `return`."""

    def limits(self, values: Mapping[str, float]) -> AutopilotLimits:
        """Return the limits, from the values of the parameters in `limit_parameters`."""
