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
        guided: What its mode is called in which set-points lead it.
        estimate: Message with the flags of its estimate of position.
        bounds_from: Parameters that say its bounds; `|` between names of the same one, of which it has one.
        says_now: Whether what it says of arming is about the mode that it is in now.
    """

    name: str
    guided: str
    estimate: int
    bounds_from: Sequence[str]
    says_now: bool

    def speaks(self, autopilot: int, vehicle: int) -> bool:
        """Return whether an autopilot is of it: MAV_AUTOPILOT and MAV_TYPE of its heartbeat."""

    def is_guided(self, mode: int) -> bool:
        """Return whether it goes where set-points say, by the custom mode of its heartbeat."""

    def guide(self) -> Command:
        """Return the command for the mode in which set-points lead it."""

    def take_off(self, height_m: float, climb_m_s: float) -> Sequence[Command]:
        """Return what makes it rise when it is armed; empty where set-points do."""

    def bring_down(self, how: str) -> Command:
        """Return the command that lets it `land` where it is, or `return`."""

    def bounds(self, values: Mapping[str, float]) -> AutopilotBounds:
        """Return its bounds, from those of `bounds_from` that it told."""
