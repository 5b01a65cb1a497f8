"""Contract of a dialect: all that a program must know of a family of autopilots to fly its drones.

Commands and their numbers are those of https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping, Protocol, Sequence, Tuple

RETURN, LAND, TAKE_OFF, SET_MODE, CHANGE_SPEED = 20, 21, 22, 176, 178
"""MAV_CMD: NAV_RETURN_TO_LAUNCH, NAV_LAND, NAV_TAKEOFF, DO_SET_MODE, DO_CHANGE_SPEED."""
ARM, PREARM_CHECKS, REQUEST = 400, 401, 512
"""MAV_CMD: COMPONENT_ARM_DISARM, RUN_PREARM_CHECKS, REQUEST_MESSAGE."""

CUSTOM_MODE = 1
"""MAV_MODE_FLAG_CUSTOM_MODE_ENABLED: the mode is in a number that each family has for itself."""

Command = Tuple[float, ...]
"""Number of a MAV_CMD, and its parameters as far as they are not 0."""


@dataclass(frozen=True)
class AutopilotBounds:
    """What an autopilot itself keeps to, in metres; None for what it does not limit, or did not say.

    Attributes:
        height_m: How high it flies, above home.
        radius_m: How far from home, over the ground.
        return_m: How high it rises at least on its way back, above home.
    """

    height_m: float | None = None
    radius_m: float | None = None
    return_m: float | None = None


class FlightDialect(Protocol):
    """How one family of autopilots is flown.

    Attributes:
        name: Of the family.
        guided: Name of the mode in which it follows set-points.
        estimate: Message with the flags of its estimate of position.
        bounds_from: Parameters with its bounds; `|` between names of the same one, of which it has one.
        says_now: Whether its arming checks are about the mode that it is in now.
    """

    name: str
    guided: str
    estimate: int
    bounds_from: Sequence[str]
    says_now: bool

    def speaks(self, autopilot: int, vehicle: int) -> bool:
        """Return whether an autopilot is of it: MAV_AUTOPILOT and MAV_TYPE of its heartbeat."""

    def is_guided(self, mode: int) -> bool:
        """Return whether it follows set-points, by the custom mode of its heartbeat."""

    def is_led(self, mode: int) -> bool:
        """Return whether programs lead it in a mode, by set-points, a mission or commands, and not a person."""

    def comes_down(self, mode: int) -> bool:
        """Return whether it lands, or returns to land, by itself in a mode."""

    def waits(self, mode: int) -> bool:
        """Return whether its failsafe for missing set-points waits in a mode for what a program commands."""

    def mode_name(self, mode: int) -> str:
        """Return the name of a mode; its number for one that is not known."""

    def guide(self) -> Command:
        """Return the command for the mode in which it follows set-points."""

    def take_off(self, height_m: float, climb_m_s: float) -> Sequence[Command]:
        """Return the commands for the take-off when it is armed; empty where set-points do it."""

    def bring_down(self, how: str) -> Command:
        """Return the command to `land` where it is, or to `return`."""

    def bounds(self, values: Mapping[str, float]) -> AutopilotBounds:
        """Return its bounds, from the values of the parameters of `bounds_from`."""
