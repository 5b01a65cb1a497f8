"""Quadrotors: point masses with an attitude, moved by thrust, gravity and drag, and controlled by an autopilot.

The autopilot is a cascade, as in PX4 (PX4 user guide, controller diagrams). The target velocity gives an acceleration
within limits. This acceleration, with compensation of gravity and drag, gives a thrust vector within bounds of tilt
and magnitude. The thrust vector gives the target roll and pitch. Roll and pitch follow with a first-order lag and a
limited rate. The thrust is chosen so that its vertical component at the actual attitude has the desired value. Let f
be the thrust per mass in axes that turn with the yaw (forward, left, up), g gravity, v the velocity, and b and c the
linear and the quadratic drag:

    f = |f| (cos(roll) sin(pitch), -sin(roll), cos(roll) cos(pitch))
    acceleration = f - g - (b + c |v|) v / mass
"""

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.physics.body import Velocity
from sim_backends.physics.collisions import ContactStop, Surface
from sim_backends.physics.robot_limits import QuadrotorLimits
from sim_backends.world.motion import GRAVITY_M_S2

_REACHED: Final = 1e-9
"""Tolerance for reaching a target, in m/s or rad: a first-order lag alone never reaches it."""
_MAX_STEPS: Final = 64
"""Number of steps for which a `Flight` is valid; it limits the number of stored poses."""


@dataclass(frozen=True, slots=True)
class FlightTarget:
    """Command of an autopilot that limits velocity and acceleration itself, and switches the rotors on and off.

    Attributes:
        velocity: The target velocity.
        acceleration_m_s2: Maximum commanded horizontal acceleration.
        climb_m_s2: Maximum commanded accelerations downwards and upwards.
        powered: False if the rotors are off; then the quadrotor falls.
    """

    velocity: Velocity
    acceleration_m_s2: float
    climb_m_s2: tuple[float, float]
    powered: bool = True

    def limits_within(self, limits: QuadrotorLimits) -> QuadrotorLimits:
        """Return a quadrotor's limits with the accelerations of this command; if rotors are off, without thrust."""
        return replace(
            limits,
            acceleration_m_s2=self.acceleration_m_s2,
            climb_m_s2=self.climb_m_s2,
            thrust_n=limits.thrust_n if self.powered else (0.0, 0.0),
        )


ROTORS_OFF: Final = FlightTarget(Velocity(), 0.0, (0.0, 0.0), powered=False)
"""Command that switches the rotors off."""


class FlightStatus(NamedTuple):
    """Values that the sensors of a quadrotor measure in addition to `State`.

    Attributes:
        place_m: Position of its lowest point, metres east, north, up.
        roll_rad: Roll, positive with the left side up.
        pitch_rad: Pitch, positive with the nose down.
        is_supported: True if it rests on something.
    """

    place_m: Vector
    roll_rad: float
    pitch_rad: float
    is_supported: bool


class FlightPose(NamedTuple):
    """Position and motion of a quadrotor.

    Attributes:
        place_m: Position of its lowest point, metres east, north, up.
        velocity_m_s: Its velocity, metres per second east, north, up.
        roll_rad: Its roll, positive with its left side up.
        pitch_rad: Its pitch, positive with its nose down.
        heading_rad: Direction of its nose, from east towards north.
    """

    place_m: Vector
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    heading_rad: float = 0.0

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Implement `Pose.tilt_rad`."""
        return self.roll_rad, self.pitch_rad


@dataclass(frozen=True, slots=True)
class Glide:
    """A course at constant velocity.

    Attributes:
        start: Its initial pose.
        velocity_m_s: Its velocity, equal to the velocity of the initial pose except for rounding.
        step_s: Length of a step.
    """

    start: FlightPose
    velocity_m_s: Vector
    step_s: float

    @property
    def steps(self) -> None:
        """Implement `Course.steps`."""

    @property
    def moves(self) -> bool:
        """Implement `Course.moves`."""
        return any(self.velocity_m_s)

    def at(self, steps: int) -> FlightPose:
        """Implement `Course.at`."""
        if not steps:
            return self.start
        (e, n, u), (v_e, v_n, v_u) = self.start.place_m, self.velocity_m_s
        t = steps * self.step_s
        return self.start._replace(place_m=(e + t * v_e, n + t * v_n, u + t * v_u), velocity_m_s=self.velocity_m_s)


class Flight:
    """A course that is integrated step by step; poses are computed on request.

    Args:
        start: Its initial pose.
        autopilot: The controller.
        target: The target velocity.
        step_s: Length of a step.
    """

    steps = _MAX_STEPS
    moves = True

    def __init__(self, start: FlightPose, autopilot: "VelocityController", target: Velocity, step_s: float) -> None:
        self._poses = [start]
        self._autopilot = autopilot
        self._target = target
        self._step_s = step_s

    def at(self, steps: int) -> FlightPose:
        """Implement `Course.at`."""
        poses = self._poses
        while len(poses) <= steps:
            poses.append(self._autopilot.fly(poses[-1], self._target, self._step_s))
        return poses[steps]


class VelocityController:
    """Controls the velocity of a quadrotor.

    Args:
        limits: Limits of the quadrotor.
    """

    def __init__(self, limits: QuadrotorLimits) -> None:
        self._limits = limits
        self._max_tilt_ratio = math.tan(limits.tilt_rad)

    def thrust_m_s2(self, velocity_m_s: Vector, target: Velocity) -> Vector:
        """Return the desired thrust per mass, east, north, up."""
        limits = self._limits
        v_e, v_n, v_u = velocity_m_s
        to_e, to_n, to_u = target.velocity_m_s
        gain_per_s, climb_per_s = limits.gains_per_s
        a_e, a_n = _limit_length(gain_per_s * (to_e - v_e), gain_per_s * (to_n - v_n), limits.acceleration_m_s2)
        a_u = _clip_range(climb_per_s * (to_u - v_u), limits.climb_m_s2)
        drag_per_s = (limits.drag_n_s_m + limits.drag_n_s2_m2 * math.hypot(v_e, v_n, v_u)) / limits.mass_kg
        up = max(a_u + GRAVITY_M_S2 + drag_per_s * v_u, limits.thrust_n[0] / limits.mass_kg)
        east, north = _limit_length(a_e + drag_per_s * v_e, a_n + drag_per_s * v_n, up * self._max_tilt_ratio)
        return east, north, up

    def fly(self, pose: FlightPose, target: Velocity, step_s: float) -> FlightPose:
        """Return the pose a step later."""
        limits = self._limits
        (e, n, u), (v_e, v_n, v_u), roll, pitch, yaw = pose
        f_e, f_n, f_u = self.thrust_m_s2(pose.velocity_m_s, target)
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        forward, left = f_e * cos_yaw + f_n * sin_yaw, f_n * cos_yaw - f_e * sin_yaw
        share, limit = -math.expm1(-step_s / limits.lag_s), limits.tilt_rate_rad_s * step_s
        pitch = _follow(pitch, math.atan2(forward, f_u), share, limit)
        roll = _follow(roll, -math.atan2(left, math.hypot(forward, f_u)), share, limit)
        if target.yaw_rad is not None:
            error_rad = math.remainder(target.yaw_rad - yaw, math.tau)
            yaw = _follow(yaw, yaw + error_rad, share, limits.yaw_rate_rad_s * step_s)
        # Actual thrust: its vertical component has the desired value, within the bounds of thrust.
        upright = math.cos(roll) * math.cos(pitch)
        f = _clip(f_u / upright, limits.thrust_n[0] / limits.mass_kg, limits.thrust_n[1] / limits.mass_kg)
        forward, left = f * math.cos(roll) * math.sin(pitch), -f * math.sin(roll)
        drag_per_s = (limits.drag_n_s_m + limits.drag_n_s2_m2 * math.hypot(v_e, v_n, v_u)) / limits.mass_kg
        a_e = forward * cos_yaw - left * sin_yaw - drag_per_s * v_e
        a_n = forward * sin_yaw + left * cos_yaw - drag_per_s * v_n
        a_u = f * upright - GRAVITY_M_S2 - drag_per_s * v_u
        half = step_s * step_s / 2
        return FlightPose(
            (e + v_e * step_s + a_e * half, n + v_n * step_s + a_n * half, u + v_u * step_s + a_u * half),
            (v_e + a_e * step_s, v_n + a_n * step_s, v_u + a_u * step_s),
            roll,
            pitch,
            yaw,
        )


def _follow(value: float, target: float, share: float, limit: float) -> float:
    return value + _clip(share * (target - value), -limit, limit)


def _clip(value: float, minimum: float, maximum: float) -> float:
    return max(minimum, min(value, maximum))


def _clip_range(value: float, limits: tuple[float, float]) -> float:
    return _clip(value, -limits[0], limits[1])


def _limit_length(first: float, second: float, limit: float) -> tuple[float, float]:
    """Return a vector, shortened to a maximum length if it is longer."""
    length = math.hypot(first, second)
    return (first, second) if length <= limit else (first * limit / length, second * limit / length)


class Quadrotor:
    """A quadrotor that follows `Velocity` and `FlightTarget` commands; without a command it hovers.

    Args:
        limits: Its limits and size.
        place_m: Position at time 0, metres east, north, up.
        heading_rad: Direction of its nose, from east towards north.
        antenna_m: Height of its antenna above its lowest point.
    """

    def __init__(
        self, limits: QuadrotorLimits, place_m: Vector, heading_rad: float = 0.0, *, antenna_m: float = 0.0
    ) -> None:
        self._limits = limits
        self._autopilot = VelocityController(limits)
        self._heading_rad = heading_rad
        self.place_m = place_m
        self.flies = True
        self.max_grade = 0.0
        self.radius_m = limits.radius_m
        self.height_m = limits.height_m
        self.antenna_m = antenna_m
        self.top_speed_m_s = limits.top_speed_m_s()

    def initial_pose(self) -> FlightPose:
        """Implement `Body.initial_pose`."""
        return self.pose_at(self.place_m, self._heading_rad)

    def pose_at(self, place_m: Vector, heading_rad: float) -> FlightPose:
        """Implement `Body.pose_at`."""
        return FlightPose(place_m, heading_rad=heading_rad)

    def on_surface(self, pose: FlightPose, surface: Surface) -> FlightPose:  # noqa: ARG002 (see Body)
        """Implement `Body.on_surface`: it flies, so the pose does not change."""
        return pose

    def course(self, pose: FlightPose, command: object, step_s: float) -> Glide | Flight:
        """Implement `Body.course`."""
        if isinstance(command, FlightTarget):
            autopilot, target = VelocityController(command.limits_within(self._limits)), command.velocity
        else:
            autopilot, target = self._autopilot, self.target(command)
        if _is_steady(autopilot, pose, target):
            return Glide(pose, target.velocity_m_s, step_s)
        return Flight(pose, autopilot, target, step_s)

    def after_contact(self, pose: FlightPose, stop: ContactStop, command: object) -> FlightPose:
        """Implement `Body.after_contact`: it keeps the component of its velocity along the obstacle.

        Without power it comes to rest in a level attitude on the ground or obstacle that supports it.
        """
        is_off = isinstance(command, FlightTarget) and not command.powered
        if is_off and any(contact.normal[2] > 0 for contact in stop.contacts):
            return FlightPose(stop.place_m, heading_rad=pose.heading_rad)
        return pose._replace(place_m=stop.place_m, velocity_m_s=stop.sliding_velocity(pose.velocity_m_s))

    def limit_m_s2(self, pose: FlightPose) -> float:
        """Implement `Body.limit_m_s2`.

        Drag opposes the velocity and grows with speed, so it never increases the difference of two velocities; its
        contribution to a velocity change is bounded by the current drag for any duration.
        """
        return self._limits.drive_m_s2() + self._limits.drag_m_s2(math.hypot(*pose.velocity_m_s))

    def target(self, command: object) -> Velocity:
        """Return a command limited to the quadrotor's limits; None means a velocity of 0.

        Raises:
            ConfigurationError: The command is not a `Velocity` of finite numbers.
        """
        if command is None:
            return Velocity()
        if not isinstance(command, Velocity) or not all(
            map(math.isfinite, (*command.velocity_m_s, command.yaw_rad or 0))
        ):
            raise ConfigurationError(
                f"a quadrotor cannot follow {command!r}", remedy="use a Velocity of finite numbers"
            )
        east, north, up = command.velocity_m_s
        limits = self._limits
        return Velocity(
            (*_limit_length(east, north, limits.speed_m_s), _clip_range(up, limits.climb_m_s)), command.yaw_rad
        )


def _is_steady(autopilot: VelocityController, pose: FlightPose, target: Velocity) -> bool:
    """Return True if a quadrotor will keep the target velocity permanently, except for rounding."""
    if math.dist(pose.velocity_m_s, target.velocity_m_s) > _REACHED:
        return False
    next_pose = autopilot.fly(pose, target, 1.0)
    changes = (abs(first - second) for first, second in zip(next_pose[2:], pose[2:], strict=True))
    return max(changes) <= _REACHED and math.dist(next_pose.velocity_m_s, pose.velocity_m_s) <= _REACHED
