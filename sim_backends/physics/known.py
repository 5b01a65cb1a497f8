"""Robots whose bodies are known, by the name of their profile."""

from typing import Final

from sim_backends.physics.differential_drive import HUSKY_A200, TURTLEBOT3_BURGER, DriveLimits
from sim_backends.physics.quadrotor import DUCKIEDRONE, IRIS, QuadrotorLimits

QUADROTORS: Final[dict[str, QuadrotorLimits]] = {"duckiedrone": DUCKIEDRONE, "iris": IRIS}
"""Those that fly."""
BODIES: Final[dict[str, DriveLimits | QuadrotorLimits]] = {
    "husky": HUSKY_A200,
    "turtlebot3_burger": TURTLEBOT3_BURGER,
    **QUADROTORS,
}
"""What robots can do; those of them that have a robot profile have a radio too."""


def quadrotor(profile: str) -> QuadrotorLimits:
    """Return what a drone of this profile can do: one whose body nobody knows, what the paper's can."""
    return QUADROTORS.get(profile, DUCKIEDRONE)
