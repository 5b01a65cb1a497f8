"""The task of a program that drives a robot, the orders of the laptop, and the duration of a path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Mapping, Sequence

WAIT = "wait"
OUT = "out"
BACK = "back"
END = "end"
ORDERS = (WAIT, OUT, BACK, END)
"""Orders of the laptop: wait, drive the path, drive back to the origin, and end the drive."""

START_M = 0.3
START_RAD = 0.3
"""Maximum distance and angle between a robot and its origin at a start. They are larger than the error after a drive
back (`ARRIVAL_TOLERANCE_M`, `HEADING_TOLERANCE_RAD`, and braking). If they are exceeded, a person has probably moved
the robot."""
OFF_PATH_M = 1.0
"""A robot that is farther from its path than this does not drive back to its origin automatically."""
GAP_S = 0.5
"""Maximum time between two iterations of the loop. After a longer gap (a suspended program) the drive ends."""

ARRIVAL_TOLERANCE_M = 0.02
"""A leg is finished when at most this distance to its corner remains."""
HEADING_TOLERANCE_RAD = 0.05
"""A turn is finished when at most this angle to the desired heading remains."""
TURN_RAMP_S = 0.5
"""Time in which the turn rate rises from 0 to its limit."""
_TURN_GAIN_PER_S = 2.0
"""Turn rate in rad/s per radian of the remaining angle near the end of a turn."""
_STEP_S = 0.01
"""Time step of the simulation in `_turn_duration_s`."""


@dataclass(frozen=True)
class DriveTask:
    """The path of a robot, and its limits. The robot stops if a limit is exceeded.

    Attributes:
        legs: Distances ahead and to the left per leg, relative to the heading at the origin, in metres.
        speed_m_s: Maximum speed.
        turn_rad_s: Maximum turn rate.
        acceleration_m_s2: Maximum acceleration.
        fence_m: Maximum distance from its origin.
        lease_s: Maximum time without an order of the laptop.
        odometry_s: Maximum time without odometry.
        limit_s: Maximum time for the path in one direction.
        origin: Its origin in the frame of its odometry: x and y in m, heading in rad; None for its current pose.
        last: Pose at the end of its last motion, in the format of `origin`; None if unknown.
        frame_id: The boot ID of its computer when the origin was recorded; empty without an origin.
        may_return: Whether it may first drive back to its origin along its path.
    """

    legs: Sequence[tuple[float, float]]
    speed_m_s: float
    turn_rad_s: float
    acceleration_m_s2: float
    fence_m: float
    lease_s: float
    odometry_s: float
    limit_s: float
    origin: Sequence[float] | None = None
    last: Sequence[float] | None = None
    frame_id: str = ""
    may_return: bool = False

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> DriveTask:
        """Return a task from its decoded JSON object."""
        return cls(**{**data, "legs": [(float(ahead), float(left)) for ahead, left in data["legs"]]})


def path_duration_s(task: DriveTask) -> float:
    """Return the duration of the path out in seconds, for a base that follows commands without delay."""
    heading_rad, duration_s = 0.0, 0.0
    for ahead_m, left_m in task.legs:
        leg_heading_rad = math.atan2(left_m, ahead_m)
        duration_s += _turn_duration_s(wrap_angle(leg_heading_rad - heading_rad), task.turn_rad_s)
        duration_s += _leg_duration_s(math.hypot(ahead_m, left_m), task)
        heading_rad = leg_heading_rad
    return duration_s


def _turn_duration_s(angle_rad: float, turn_rad_s: float) -> float:
    """Return the duration of a turn in place. The turn rates of `Driver` are simulated."""
    remaining_rad, rate_rad_s, duration_s = abs(angle_rad), 0.0, 0.0
    while remaining_rad > HEADING_TOLERANCE_RAD:
        rate_rad_s = min(
            rate_rad_s + turn_rad_s / TURN_RAMP_S * _STEP_S, turn_rad_s, turn_rate_rad_s(remaining_rad, turn_rad_s)
        )
        remaining_rad -= rate_rad_s * _STEP_S
        duration_s += _STEP_S
    return duration_s


def _leg_duration_s(length_m: float, task: DriveTask) -> float:
    """Return the duration of a leg: acceleration, constant speed, and braking with half of the acceleration.

    The leg ends at the distance `ARRIVAL_TOLERANCE_M` from its corner, so the robot does not brake to zero.
    """
    acceleration = task.acceleration_m_s2
    # Acceleration needs the distance v^2 / 2a, and braking needs v^2 / a: together 1.5 v^2 / a.
    speed_m_s = min(task.speed_m_s, math.sqrt(acceleration * length_m / 1.5))
    final_m_s = min(speed_m_s, math.sqrt(acceleration * ARRIVAL_TOLERANCE_M))
    constant_speed_m = length_m - 1.5 * speed_m_s**2 / acceleration
    return (speed_m_s + 2 * (speed_m_s - final_m_s)) / acceleration + constant_speed_m / speed_m_s


def turn_rate_rad_s(remaining_rad: float, turn_rad_s: float) -> float:
    """Return the turn rate for a remaining angle.

    It is the maximum rate at which half of the angular acceleration suffices to stop in time. Near the end of the
    turn, it is proportional to the remaining angle (`_TURN_GAIN_PER_S`).
    """
    return min(_TURN_GAIN_PER_S * remaining_rad, math.sqrt(turn_rad_s / TURN_RAMP_S * remaining_rad))


def wrap_angle(angle_rad: float) -> float:
    """Return an angle that is normalized to the range from -pi to pi."""
    return math.remainder(angle_rad, 2 * math.pi)
