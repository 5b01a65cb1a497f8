"""Limits of the robots that the physics supports, by the name of their robot profile."""

from typing import Final

from sim_backends.physics.differential_drive import HUSKY_A200, TURTLEBOT3_BURGER, DriveLimits
from sim_backends.physics.quadrotor import DUCKIEDRONE, IRIS, QuadrotorLimits

QUADROTORS: Final[dict[str, QuadrotorLimits]] = {"duckiedrone": DUCKIEDRONE, "iris": IRIS}
"""Flying robots."""
BODIES: Final[dict[str, DriveLimits | QuadrotorLimits]] = {
    "husky": HUSKY_A200,
    "turtlebot3_burger": TURTLEBOT3_BURGER,
    **QUADROTORS,
}
"""All robots; robots with a robot profile also have a radio."""


def quadrotor(profile: str) -> QuadrotorLimits:
    """Return the limits of a drone of this profile; the limits of the paper's drone if the profile is unknown."""
    return QUADROTORS.get(profile, DUCKIEDRONE)
