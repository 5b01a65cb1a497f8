"""Robots that steer by the difference of their wheels' speeds: unicycles with limits.

Forward speed and rate of turn go to what was commanded as fast as their limits let them, each by itself, as ROS's
`diff_drive_controller` lets them. With the acceleration a and the rate of turn w constant, the way in a time t is
exact (the integral of speed along the heading, about its middle): with the speed in the middle v, the heading in the
middle h and x = w t / 2,

    along h:     v t sin(x) / x
    left of h:   a t^2 / 2 (sin(x) - x cos(x)) / x^2

Where the rate of turn changes while the robot moves, that is a Fresnel integral: then one step is taken with the
rate in its middle, which is wrong by less than v (dw/dt) t^3 / 12.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.physics.body import GRAVITY_M_S2, Twist
from sim_backends.physics.collisions import TOUCH_M, ContactStop, Surface

_LEVEL: Final = (0.0, 0.0)
_SAME: Final = 1e-12
"""What is nearer to its target, in m/s or rad/s, has reached it: rounding alone is that large."""

_NO_GRIP_M_S2: Final = 1e-9
"""With less its speed cannot be changed on a slope: what is left of friction there is rounding."""


@dataclass(frozen=True)
class DriveLimits:
    """What a robot with a differential drive can do, and how large it is.

    Attributes:
        speed_m_s: Most it drives, ahead or back.
        acceleration_m_s2: Most its speed changes per second, also when it brakes.
        turn_rad_s: Most it turns.
        turn_acceleration_rad_s2: Most its rate of turn changes per second.
        radius_m: Of the upright cylinder that contains it.
        height_m: Of that cylinder.
        friction: Coefficient of friction of its tires; it holds on slopes that rise by less than that over their run.
    """

    speed_m_s: float
    acceleration_m_s2: float
    turn_rad_s: float
    turn_acceleration_rad_s2: float
    radius_m: float
    height_m: float
    friction: float = 0.8


HUSKY_A200: Final = DriveLimits(1.0, 3.0, 2.0, 6.0, radius_m=0.6, height_m=0.39, friction=1.0)
"""Clearpath Husky A200: 1.0 m/s, 990 mm x 670 mm x 390 mm, climbs 45 degrees (data sheet); accelerations and rate of
turn of `husky_control/config/control.yaml` (github.com/husky/husky)."""

TURTLEBOT3_BURGER: Final = DriveLimits(0.22, 2.5, 2.84, 3.2, radius_m=0.113, height_m=0.192)
"""ROBOTIS TurtleBot3 Burger: 0.22 m/s, 2.84 rad/s, 138 mm x 178 mm x 192 mm (e-Manual, specifications); accelerations
of `turtlebot3_navigation2/param/burger.yaml` (github.com/ROBOTIS-GIT/turtlebot3); friction of rubber on dry ground,
an estimate of ours."""


class DrivePose(NamedTuple):
    """Where a robot on wheels is and how it moves.

    Attributes:
        place_m: Metres east, north, up, of the ground below its centre.
        heading_rad: From east towards north; it is counted on over full turns.
        speed_m_s: Ahead, below 0 for backwards.
        turn_rad_s: Rate of turn, above 0 to the left.
        slides_m_s: How it moves along what it touches; None where it moves as it heads.
        grade: How much the ground below it rises per metre east and north.
    """

    place_m: Vector
    heading_rad: float
    speed_m_s: float = 0.0
    turn_rad_s: float = 0.0
    slides_m_s: Vector | None = None
    grade: tuple[float, float] = (0.0, 0.0)

    @property
    def velocity_m_s(self) -> Vector:
        """See `Pose.velocity_m_s`."""
        if self.slides_m_s is not None:
            return self.slides_m_s
        ahead, up = _ahead(self.grade, self.heading_rad)
        return (
            self.speed_m_s * ahead * math.cos(self.heading_rad),
            self.speed_m_s * ahead * math.sin(self.heading_rad),
            self.speed_m_s * up,
        )


@dataclass(frozen=True, slots=True)
class Arc:
    """A course of constant accelerations.

    Attributes:
        begin: Where it begins.
        speed_m_s: Speed from there on, which is its own but for rounding.
        turn_rad_s: Likewise, the rate of turn.
        acceleration_m_s2: Change of speed per second.
        turn_acceleration_rad_s2: Change of the rate of turn per second.
        steps: See `Course.steps`.
        step_s: How long a step is.
    """

    begin: DrivePose
    speed_m_s: float
    turn_rad_s: float
    acceleration_m_s2: float
    turn_acceleration_rad_s2: float
    steps: int | None
    step_s: float

    @property
    def moves(self) -> bool:
        """See `Course.moves`."""
        return bool(self.speed_m_s or self.acceleration_m_s2)

    def at(self, steps: int) -> DrivePose:
        """See `Course.at`."""
        if not steps:
            return self.begin
        t = steps * self.step_s
        (east_m, north_m, up_m), heading_rad = self.begin.place_m, self.begin.heading_rad
        middle_m_s = self.speed_m_s + self.acceleration_m_s2 * t / 2
        half_rad = (self.turn_rad_s + self.turn_acceleration_rad_s2 * t / 2) * t / 2
        sinc, lean = _arc(half_rad)
        ahead_m, left_m = middle_m_s * t * sinc, self.acceleration_m_s2 * t * t / 2 * lean
        cos, sin = math.cos(heading_rad + half_rad), math.sin(heading_rad + half_rad)
        east, north = ahead_m * cos - left_m * sin, ahead_m * sin + left_m * cos
        grade = self.begin.grade
        if grade != _LEVEL:
            flat, _ = _ahead(grade, heading_rad + half_rad)
            east, north = east * flat, north * flat
            up_m += grade[0] * east + grade[1] * north
        return DrivePose(
            (east_m + east, north_m + north, up_m),
            heading_rad + 2 * half_rad,
            self.speed_m_s + self.acceleration_m_s2 * t,
            self.turn_rad_s + self.turn_acceleration_rad_s2 * t,
            None,
            grade,
        )


def _ahead(grade: tuple[float, float], heading_rad: float) -> tuple[float, float]:
    """Return how far it is ahead on the map, and up, for each metre that is driven on a slope."""
    if grade == _LEVEL:
        return 1.0, 0.0
    rise = grade[0] * math.cos(heading_rad) + grade[1] * math.sin(heading_rad)
    flat = 1 / math.hypot(1.0, rise)
    return flat, rise * flat


def _arc(x: float) -> tuple[float, float]:
    """Return sin(x) / x and (sin(x) - x cos(x)) / x^2."""
    if abs(x) < 1e-3:  # of the series the next terms, x^4 / 120 and x^5 / 840, are below rounding
        return 1 - x * x / 6, x / 3 - x**3 / 30
    return math.sin(x) / x, (math.sin(x) - x * math.cos(x)) / (x * x)


class DifferentialDrive:
    """A robot on wheels that takes `Twist` commands; without one it stands.

    Args:
        limits: What it can do.
        place_m: Where it is at time 0, metres east and north.
        heading_rad: Where it heads, from east towards north.
        antenna_m: Height of its antenna over the ground.
    """

    def __init__(
        self,
        limits: DriveLimits,
        place_m: tuple[float, float],
        heading_rad: float = 0.0,
        *,
        antenna_m: float | None = None,
    ) -> None:
        self._limits = limits
        self.place_m = (*place_m, 0.0)
        self._heading_rad = heading_rad
        self.flies = False
        self.steepest = limits.friction
        self.radius_m = limits.radius_m
        self.height_m = limits.height_m
        self.antenna_m = limits.height_m if antenna_m is None else antenna_m
        self.top_speed_m_s = limits.speed_m_s

    def begin(self) -> DrivePose:
        """See `Body.begin`."""
        return DrivePose(self.place_m, self._heading_rad)

    def placed(self, pose: DrivePose, surface: Surface) -> DrivePose:
        """See `Body.placed`."""
        if surface.grade == pose.grade and abs(surface.height_m - pose.place_m[2]) <= TOUCH_M:
            return pose
        return pose._replace(place_m=(*pose.place_m[:2], surface.height_m), grade=surface.grade)

    def course(self, pose: DrivePose, command: object, step_s: float) -> Arc:
        """See `Body.course`."""
        limits = self._limits
        twist = _twist(command)
        speed_m_s = _within(twist.forward_m_s, limits.speed_m_s)
        turn_rad_s = _within(twist.turn_rad_s, limits.turn_rad_s)
        most_m_s2 = self._acceleration_m_s2(pose, faster=speed_m_s > pose.speed_m_s)
        slips = most_m_s2 <= _NO_GRIP_M_S2 and speed_m_s != pose.speed_m_s
        if slips:  # the slope takes all of the friction
            speed_m_s = pose.speed_m_s
        a_m_s2, speeding = _towards(pose.speed_m_s, speed_m_s, most_m_s2, step_s)
        a_rad_s2, turning = _towards(pose.turn_rad_s, turn_rad_s, limits.turn_acceleration_rad_s2, step_s)
        steps = min((some for some in (speeding, turning) if some), default=None)
        turns = bool(turning or turn_rad_s)
        if (turning or (turns and pose.grade != _LEVEL)) and (speeding or speed_m_s or slips):
            steps = 1  # see the top of this module
        return Arc(
            pose,
            pose.speed_m_s if speeding else speed_m_s,
            pose.turn_rad_s if turning else turn_rad_s,
            a_m_s2,
            a_rad_s2,
            steps,
            step_s,
        )

    def _acceleration_m_s2(self, pose: DrivePose, *, faster: bool) -> float:
        """Return how fast its speed can grow or fall on the ground that it is on.

        Its tires carry friction times the normal force, m g cos(slope), in all directions together; across its
        heading they hold it against gravity, along it gravity helps or hinders.
        """
        limits = self._limits
        if pose.grade == _LEVEL:
            return min(limits.acceleration_m_s2, limits.friction * GRAVITY_M_S2)
        steepness = math.hypot(*pose.grade)
        normal_m_s2 = GRAVITY_M_S2 / math.hypot(1.0, steepness)
        _, up = _ahead(pose.grade, pose.heading_rad)
        back_m_s2 = GRAVITY_M_S2 * up
        across_m_s2 = math.sqrt(max((steepness * normal_m_s2) ** 2 - back_m_s2**2, 0.0))
        held_m_s2 = math.sqrt(max((limits.friction * normal_m_s2) ** 2 - across_m_s2**2, 0.0))
        return min(limits.acceleration_m_s2, held_m_s2 - back_m_s2 if faster else held_m_s2 + back_m_s2)

    def stopped(self, pose: DrivePose, stop: ContactStop, command: object) -> DrivePose:
        """See `Body.stopped`.

        Against a wall it goes on along it with what its velocity has of that direction; its drive does no more than
        what it was commanded has of it, so that one which heads straight into a wall stands.
        """
        heading: Vector = (math.cos(pose.heading_rad), math.sin(pose.heading_rad), 0.0)
        left: Vector = stop.along(heading if pose.speed_m_s > 0 else (-heading[0], -heading[1], 0.0))
        share = math.hypot(*left)
        most_m_s = min(abs(pose.speed_m_s), abs(_twist(command).forward_m_s) * share)
        return pose._replace(
            place_m=stop.place_m,
            speed_m_s=math.copysign(most_m_s, pose.speed_m_s),
            slides_m_s=(most_m_s * left[0], most_m_s * left[1], 0.0),
        )

    def limit_m_s2(self, pose: DrivePose) -> float:
        """See `Body.limit_m_s2`: along the heading by the drive, across it by turning."""
        limits = self._limits
        leans = math.hypot(1.0, *pose.grade)
        return math.hypot(limits.acceleration_m_s2, limits.speed_m_s * limits.turn_rad_s * leans)


def _twist(command: object) -> Twist:
    if command is None:
        return Twist()
    if not isinstance(command, Twist) or not (
        math.isfinite(command.forward_m_s) and math.isfinite(command.turn_rad_s)
    ):
        raise ConfigurationError(
            f"a robot on wheels cannot do {command!r}", remedy="command it by a Twist of finite numbers"
        )
    return command


def _within(value: float, limit: float) -> float:
    return max(-limit, min(value, limit))


def _towards(now: float, target: float, limit: float, step_s: float) -> tuple[float, int]:
    """Return the rate at which a value goes to its target, and for how many whole steps; 0 and 0 where it is there.

    What is left when no whole step at the limit fits any more takes one step at a smaller rate.
    """
    missing = target - now
    if abs(missing) <= _SAME:
        return 0.0, 0
    whole = math.floor(abs(missing) / (limit * step_s) + 1e-9)
    return (math.copysign(limit, missing), whole) if whole else (missing / step_s, 1)
