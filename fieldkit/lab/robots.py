"""The robots of a lab, and destinations to which they move."""

from dataclasses import dataclass

from fieldkit.config.profiles import RobotProfile


@dataclass(frozen=True)
class LabRobot:
    """A robot of a lab.

    Attributes:
        name: Its name.
        profile: Its profile.
        address: Its IPv4 address on the radio.
        roles: Its roles in trials, as text: `sender (master)`.
    """

    name: str
    profile: RobotProfile
    address: str
    roles: tuple[str, ...] = ()


@dataclass(frozen=True)
class Destination:
    """Destination of a robot: the position of its antenna.

    Attributes:
        east_m: Metres east of the world's south-western corner, or of the robot if `relative`.
        north_m: Metres north of the same point.
        up_m: Height of the antenna in the world, or change of its height above the ground if `relative`. None keeps
            the height above the ground if `relative`, and puts the robot on the ground otherwise.
        relative: Whether the other values are relative to the robot's current position.
    """

    east_m: float
    north_m: float
    up_m: float | None
    relative: bool
