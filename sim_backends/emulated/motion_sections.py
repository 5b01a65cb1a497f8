"""Sections of robot profiles that emulated robots implement: the base of a ground robot, the autopilot of a drone.

If the package that defines their models (`fieldkit.config.profiles.ProfileSection`) is not installed, no profile has
these sections.
"""

from collections.abc import Iterable
from typing import Final, Protocol, cast

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import RobotProfile

DRIVE: Final = "drive"
MAVLINK: Final = "mavlink"


class DriveSection(Protocol):
    """The base of a ground robot, driven by velocities on a topic; keys: docs/reference/robot-profile.md."""

    topic: str
    type: str
    turn_rad_s: float
    acceleration_m_s2: float

    def topic_conflict(self, robot: Robot, others: Iterable[Robot]) -> str | None:
        """Return the reason why a robot cannot be driven by this section next to other robots; None if it can."""
        ...


class MavlinkSection(Protocol):
    """The autopilot of a drone."""

    port: int
    autopilot: str
    system: int
    boot_s: float


def drive_of(profile: RobotProfile) -> DriveSection | None:
    """Return the section `drive` of a profile, or None if it has no such section."""
    return cast("DriveSection | None", profile.sections.get(DRIVE))


def mavlink_of(profile: RobotProfile) -> MavlinkSection | None:
    """Return the section `mavlink` of a profile, or None if it has no such section."""
    return cast("MavlinkSection | None", profile.sections.get(MAVLINK))
