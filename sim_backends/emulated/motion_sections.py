"""Sections of robot profiles that emulated robots implement: the base of a ground robot, the autopilot of a drone.

An installed package defines their models (`fieldkit.config.profiles.ProfileSection`); without it no profile has them.
"""

from collections.abc import Iterable
from typing import Final, Protocol, cast

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import RobotProfile

DRIVE: Final = "drive"
MAVLINK: Final = "mavlink"


class DriveSection(Protocol):
    """How a ground robot is driven by velocities on a topic."""

    @property
    def topic(self) -> str:
        """Topic of velocities."""
        ...

    @property
    def turn_rad_s(self) -> float:
        """Maximum turn rate."""
        ...

    @property
    def acceleration_m_s2(self) -> float:
        """Maximum acceleration."""
        ...

    def topic_conflict(self, robot: Robot, others: Iterable[Robot]) -> str | None:
        """Return why a robot cannot be driven by this section next to other robots; None if it can."""
        ...


class MavlinkSection(Protocol):
    """The autopilot of a drone."""

    @property
    def port(self) -> int:
        """UDP port on the radio."""
        ...

    @property
    def autopilot(self) -> str:
        """Its firmware: `px4` or `ardupilot`."""
        ...

    @property
    def system(self) -> int:
        """Its MAVLink system id after power-on."""
        ...

    @property
    def boot_s(self) -> float:
        """Time from power-on until its position estimate has an origin, in seconds."""
        ...


def drive_of(profile: RobotProfile) -> DriveSection | None:
    """Return the section `drive` of a profile, or None if it has no such section."""
    return cast("DriveSection | None", profile.sections.get(DRIVE))


def mavlink_of(profile: RobotProfile) -> MavlinkSection | None:
    """Return the section `mavlink` of a profile, or None if it has no such section."""
    return cast("MavlinkSection | None", profile.sections.get(MAVLINK))
