"""How the emulated drone flies: as the quadrotor of the physics federate, among what stands in its world.

Time is handed in as integer nanoseconds and goes on in steps of equal length, so a flight is the same however often
somebody asks for it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.physics.body import Velocity
from sim_backends.physics.collisions import Footprint, gap_m, move
from sim_backends.physics.quadrotor import FlightPose, Quadrotor, QuadrotorLimits

STEP_NS: Final = 10_000_000
_STEP_S: Final = STEP_NS / 1e9

_APPROACH: Final = 0.5
"""Near its goal the speed falls in proportion to what is left, by this share of the gain of the speed itself: it
goes beyond by 4 % at most where nothing lags (PX4 has 0.95 for MPC_XY_P, and 1.8 for MPC_XY_VEL_P_ACC)."""

_HEADS_M_S: Final = 0.3
"""A slower drone does not turn to its direction of flight."""
_REST_M: Final = 1e-3
"""Who would come so much deeper, had it its way, stands."""
_LOOK_M: Final = 2.0
"""How far around what may be in its way is looked for, each time that it has flown half as far."""


class Airframe:
    """The drone: metres and m/s east, north, up of home; radians from east towards north.

    Args:
        can: What it can do.
        place_m: Place of its lowest point in the world; home is there, too.
        facing_rad: Where its nose points.
        around: What is in its way in the world, the floor too.
        now_ns: When that is.

    Attributes:
        home_m: Place of home in the world; `position_m` is relative to it.
        now_ns: The moment at which it is so.
        driven: Whether its motors turn: without them it stands, or falls.
        on_ground: Whether it stands on something.
        turn_rad_s: How fast it turns to the left.
    """

    def __init__(
        self, can: QuadrotorLimits, place_m: Vector, facing_rad: float, around: Sequence[Footprint], now_ns: int
    ) -> None:
        self.now_ns = now_ns
        self.driven = False
        self.on_ground = True
        self.turn_rad_s = 0.0
        self._pose = FlightPose(place_m, heading_rad=facing_rad)
        self.home_m = place_m
        self._around = around
        self._near: Sequence[Footprint] = ()
        self._looked_m: Vector = (math.inf, 0.0, 0.0)
        self._can = can
        self._quadrotor = Quadrotor(can, place_m)
        self._dead = Quadrotor(replace(can, thrust_n=(0.0, 0.0)), place_m)

    @property
    def position_m(self) -> Vector:
        """Where it is, seen from home."""
        (east, north, up), home = self._pose.place_m, self.home_m
        return east - home[0], north - home[1], up - home[2]

    @property
    def place_m(self) -> Vector:
        """Where its lowest point is in the world."""
        return self._pose.place_m

    @property
    def velocity_m_s(self) -> Vector:
        """How it moves."""
        return self._pose.velocity_m_s

    @property
    def yaw_rad(self) -> float:
        """Where its nose points."""
        return self._pose.heading_rad

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Roll (right side down) and pitch (nose up), as MAVLink has them."""
        return self._pose.roll_rad, -self._pose.pitch_rad

    def step(self, wanted_m_s: Vector, can: QuadrotorLimits, yaw_rad: float | None = None) -> None:
        """Fly for one step towards this velocity, within its limits; the ground and obstacles stop it.

        Args:
            wanted_m_s: The velocity.
            can: What it can do.
            yaw_rad: Heading to turn to; None to keep the heading.
        """
        self.now_ns += STEP_NS
        if can != self._can:
            self._can, self._quadrotor = can, Quadrotor(can, self._pose.place_m)
        body = self._quadrotor if self.driven else self._dead
        before_m = self._pose.place_m
        pose = body.course(self._pose, Velocity(wanted_m_s, yaw_rad), _STEP_S).at(1)
        around = self._look(before_m)
        stop = move(body, before_m, pose.place_m, around)
        if stop is not None:
            pose = body.stopped(pose, stop, None)
        self.turn_rad_s = math.remainder(pose.heading_rad - self._pose.heading_rad, math.tau) / _STEP_S
        self._pose = pose
        self.on_ground = pose.velocity_m_s[2] <= _REST_M and self._rests(around)
        if self.on_ground and (not self.driven or wanted_m_s[2] <= 0):
            # It neither slides nor leans nor turns.
            self._pose, self.turn_rad_s = FlightPose(pose.place_m, heading_rad=pose.heading_rad), 0.0

    def _rests(self, around: Sequence[Footprint]) -> bool:
        east, north, up = self._pose.place_m
        stop = move(self._quadrotor, self._pose.place_m, (east, north, up - _REST_M), around)
        return stop is not None and any(contact.normal[2] > 0 for contact in stop.contacts)

    def _look(self, place_m: Vector) -> Sequence[Footprint]:
        """Return what it may meet in this step."""
        if not math.dist(place_m, self._looked_m) < _LOOK_M / 2:
            self._looked_m = place_m
            self._near = [one for one in self._around if gap_m(one, self._quadrotor, place_m) < _LOOK_M]
        return self._near

    @property
    def course_rad(self) -> float | None:
        """Direction in which it flies over the ground; None while it is slow."""
        east, north, _ = self.velocity_m_s
        return math.atan2(north, east) if math.hypot(east, north) > _HEADS_M_S else None


def velocity_to(goal_m: Vector, body: Airframe, can: QuadrotorLimits) -> Vector:
    """Return with which velocity to fly to a point, seen from home, so that the brakes are enough to stop there."""
    east, north, up = (goal - here for goal, here in zip(goal_m, body.position_m, strict=True))
    far_m = math.hypot(east, north)
    along_per_s, climb_per_s = can.gains_per_s
    speed_m_s = min(can.speed_m_s, _approach(far_m, can.acceleration_m_s2, along_per_s))
    part = speed_m_s / far_m if far_m > 0 else 0.0
    down, rise = can.climb_m_s2
    climb_m_s = math.copysign(_approach(abs(up), rise if up < 0 else down, climb_per_s), up)
    return east * part, north * part, climb_m_s


def stop_m(body: Airframe, can: QuadrotorLimits) -> Vector:
    """Return where it can come to stand, seen from home, not below it.

    What its attitude and its gain let it do first at the speed of now, then v^2 / 2a.
    """
    (x, y, z), (east, north, up) = body.position_m, body.velocity_m_s
    brake_s = can.lag_s + 1 / can.gains_per_s[0] + math.hypot(east, north) / 2 / can.acceleration_m_s2
    climb_s = 1 / can.gains_per_s[1] + abs(up) / 2 / can.climb_m_s2[0 if up > 0 else 1]
    return x + east * brake_s, y + north * brake_s, max(z + up * climb_s, min(z, 0.0))


def _approach(left_m: float, acceleration_m_s2: float, gain_per_s: float) -> float:
    """Return how fast to be at this distance: in proportion to it near by, else v^2 = a s, half of v^2 = 2 a s."""
    return min(left_m * _APPROACH * gain_per_s, math.sqrt(acceleration_m_s2 * left_m))
