"""How the emulated drone flies: a point mass with limits of speed and acceleration, over flat ground.

Time is handed in as integer nanoseconds and goes on in steps of equal length, so a flight is the same however often
somebody asks for it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Vector

GRAVITY_M_S2: Final = 9.80665
"""Standard gravity (ISO 80000-3)."""

STEP_NS: Final = 10_000_000
_STEP_S: Final = STEP_NS / 1e9

_APPROACH_PER_S: Final = 1.0
"""Near its goal the speed falls in proportion to what is left (PX4's MPC_XY_P is 0.95): it never goes beyond."""

_TURN_RAD_S: Final = math.radians(90)
_HEADS_M_S: Final = 0.3
"""Slower than this a drone does not turn to where it flies."""


@dataclass(frozen=True)
class Envelope:
    """What the drone can do: speeds in m/s, accelerations in m/s^2."""

    speed_m_s: float
    climb_m_s: float
    descent_m_s: float
    acceleration_m_s2: float
    climb_acceleration_m_s2: float


@dataclass
class PointMass:
    """The drone in the air: metres and m/s east, north, up of home; radians from east towards north.

    Attributes:
        now_ns: The moment at which it is so.
        driven: Whether its motors turn: without them it stands, or falls.
    """

    now_ns: int
    position_m: Vector = (0.0, 0.0, 0.0)
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    acceleration_m_s2: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float = math.pi / 2
    driven: bool = False

    @property
    def on_ground(self) -> bool:
        """Whether it stands on the ground."""
        return self.position_m[2] <= 0 and self.velocity_m_s[2] <= 0

    def step(self, wanted_m_s: Vector, envelope: Envelope) -> None:
        """Fly for one step towards this velocity, as far as the envelope allows."""
        self.now_ns += STEP_NS
        before = self.velocity_m_s
        after = _towards(before, within(wanted_m_s, envelope), envelope) if self.driven else _falling(before)
        east, north, up = (p + (b + a) / 2 * _STEP_S for p, b, a in zip(self.position_m, before, after, strict=True))
        if up <= 0 and after[2] <= 0:
            up, after = 0.0, (0.0, 0.0, 0.0)  # the ground holds it
        self.position_m, self.velocity_m_s = (east, north, up), after
        self.acceleration_m_s2 = _vector((a - b) / _STEP_S for b, a in zip(before, after, strict=True))
        self._turn()

    def _turn(self) -> None:
        """Turn the nose to where it flies."""
        east, north, _ = self.velocity_m_s
        if math.hypot(east, north) > _HEADS_M_S:
            off_rad = math.remainder(math.atan2(north, east) - self.yaw_rad, math.tau)
            most_rad = _TURN_RAD_S * _STEP_S
            self.yaw_rad = math.remainder(self.yaw_rad + min(max(off_rad, -most_rad), most_rad), math.tau)

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Roll (right side down) and pitch (nose up): thrust stands along gravity and acceleration together."""
        east, north, up = self.acceleration_m_s2
        ahead = east * math.cos(self.yaw_rad) + north * math.sin(self.yaw_rad)
        right = east * math.sin(self.yaw_rad) - north * math.cos(self.yaw_rad)
        pull = max(GRAVITY_M_S2 + up, 1.0)
        return math.atan2(right, pull), math.atan2(-ahead, pull)


def within(velocity_m_s: Vector, envelope: Envelope) -> Vector:
    """Return a velocity of this direction over the ground that the envelope allows."""
    east, north, up = velocity_m_s
    part = min(1.0, envelope.speed_m_s / max(math.hypot(east, north), 1e-9))
    return east * part, north * part, min(max(up, -envelope.descent_m_s), envelope.climb_m_s)


def velocity_to(goal_m: Vector, body: PointMass, envelope: Envelope) -> Vector:
    """Return with which velocity to fly to a point, so that the brakes are enough to stop there."""
    east, north, up = (goal - here for goal, here in zip(goal_m, body.position_m, strict=True))
    far_m = math.hypot(east, north)
    speed_m_s = min(envelope.speed_m_s, _approach(far_m, envelope.acceleration_m_s2))
    part = speed_m_s / far_m if far_m > 0 else 0.0
    climb_m_s = math.copysign(_approach(abs(up), envelope.climb_acceleration_m_s2), up)
    return within((east * part, north * part, climb_m_s), envelope)


def _approach(left_m: float, acceleration_m_s2: float) -> float:
    """Return how fast to be at this distance: in proportion to it near by, else v^2 = a s, half of v^2 = 2 a s."""
    return min(left_m * _APPROACH_PER_S, math.sqrt(acceleration_m_s2 * left_m))


def _towards(now: Vector, wanted: Vector, envelope: Envelope) -> Vector:
    """Return the velocity after one step of acceleration."""
    east, north, up = (w - n for w, n in zip(wanted, now, strict=True))
    part = min(1.0, envelope.acceleration_m_s2 * _STEP_S / max(math.hypot(east, north), 1e-9))
    most = envelope.climb_acceleration_m_s2 * _STEP_S
    return now[0] + east * part, now[1] + north * part, now[2] + min(max(up, -most), most)


def _falling(now: Vector) -> Vector:
    return now[0], now[1], now[2] - GRAVITY_M_S2 * _STEP_S


def _vector(values: Iterable[float]) -> Vector:
    east, north, up = values
    return east, north, up
