"""What the laptop tells a program that drives a robot: its task, the words of orders; and how long the way takes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Mapping, Sequence

WAIT = "wait"
OUT = "out"
BACK = "back"
END = "end"
ORDERS = (WAIT, OUT, BACK, END)
"""What the laptop can order: that the robot waits where it is, goes its way, comes back, or stops for good."""

START_M = 0.3
START_RAD = 0.3
"""A robot starts no farther than this from its origin, in place and heading: more than a drive back leaves
(`ARRIVED_M`, `FACES_RAD`, and its braking), and less than a robot that was moved."""
OFF_PATH_M = 1.0
"""A robot that is farther off its path than this does not drive back to its origin by itself."""
GAP_S = 0.5
"""Longer than this between two turns of its loop the program was suspended: the drive ends."""

ARRIVED_M = 0.02
"""So near a corner it is there."""
FACES_RAD = 0.05
"""So near a heading it faces there."""
TURNS_UP_S = 0.5
"""How long its turning takes to come up to its limit."""
_TURN_PER_S = 2.0
_STEP_S = 0.01


@dataclass(frozen=True)
class DriveTask:
    """What a robot is to drive, and what must hold meanwhile.

    Attributes:
        legs: Of each how far ahead, and to the left, as the robot faces at its origin; in metres.
        speed_m_s: How fast it drives.
        turn_rad_s: Most that it turns.
        acceleration_m_s2: Most that its speed grows per second.
        fence_m: Farther than this from its origin it stops.
        lease_s: It stops where the laptop has not renewed its lease for so long.
        odometry_s: It stops where its odometry was silent for so long.
        limit_s: It stops where one way takes longer.
        origin: Its origin in the frame of its odometry: x and y in m, heading in rad; None for where it is now.
        last: Where its last motion ended, likewise; None if that is unknown.
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
        """Return a task from what JSON made of it."""
        return cls(**{**data, "legs": [(float(ahead), float(left)) for ahead, left in data["legs"]]})


def way_s(task: DriveTask) -> float:
    """Return how long its way takes, in seconds, on a base that does at once what it is told."""
    heading_rad, took_s = 0.0, 0.0
    for ahead_m, left_m in task.legs:
        towards_rad = math.atan2(left_m, ahead_m)
        took_s += _turn_s(wrapped(towards_rad - heading_rad), task.turn_rad_s)
        took_s += _leg_s(math.hypot(ahead_m, left_m), task)
        heading_rad = towards_rad
    return took_s


def _turn_s(angle_rad: float, turn_rad_s: float) -> float:
    """Return how long it stands and turns; as its driver does it, step by step."""
    left_rad, rate_rad_s, took_s = abs(angle_rad), 0.0, 0.0
    while left_rad > FACES_RAD:
        rate_rad_s = min(
            rate_rad_s + turn_rad_s / TURNS_UP_S * _STEP_S, turn_rad_s, turning_rad_s(left_rad, turn_rad_s)
        )
        left_rad -= rate_rad_s * _STEP_S
        took_s += _STEP_S
    return took_s


def _leg_s(long_m: float, task: DriveTask) -> float:
    """Return how long it drives along a leg: up to its speed, on, and down with half of its acceleration."""
    acceleration = task.acceleration_m_s2
    speed_m_s = min(task.speed_m_s, math.sqrt(acceleration * long_m / 1.5))
    arrives_m_s = min(speed_m_s, math.sqrt(acceleration * ARRIVED_M))
    even_m = long_m - 1.5 * speed_m_s**2 / acceleration
    return (speed_m_s + 2 * (speed_m_s - arrives_m_s)) / acceleration + even_m / speed_m_s


def turning_rad_s(off_rad: float, turn_rad_s: float) -> float:
    """Return how fast to turn with so much left: from there half of what its turning can change stops it."""
    return min(_TURN_PER_S * off_rad, math.sqrt(turn_rad_s / TURNS_UP_S * off_rad))


def wrapped(angle_rad: float) -> float:
    """Return an angle as the nearest one to 0 that faces there."""
    return math.remainder(angle_rad, 2 * math.pi)
