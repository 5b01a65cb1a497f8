"""Quadrotors: point masses with an attitude, moved by thrust, gravity and drag, and flown by an autopilot.

The autopilot is a cascade, as PX4's is (PX4 user guide, controller diagrams): a wanted velocity gives an acceleration
within limits; with gravity and drag, which it knows, that gives a thrust vector within bounds of tilt and size; that
gives roll and pitch. Those follow with a first-order lag and a limited rate, and thrust is such that its vertical
part is the wanted one at the attitude that is. With f the thrust per mass, along its yaw (forward, left, up),

    f = |f| (cos(roll) sin(pitch), -sin(roll), cos(roll) cos(pitch)),
    acceleration = f - g - (linear + quadratic |v|) v / mass.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.physics.body import GRAVITY_M_S2, Velocity
from sim_backends.physics.collisions import ContactStop, Surface

_SAME: Final = 1e-9
"""What is nearer to its target, in m/s or rad, is there: a lag alone never gets there."""
_LONGEST: Final = 64
"""Steps of a course: so many poses it keeps at most."""


@dataclass(frozen=True)
class QuadrotorLimits:
    """What a quadrotor can do, and how large it is.

    Attributes:
        mass_kg: Its mass.
        thrust_n: Least and most thrust of all rotors together.
        tilt_rad: Most roll, and most pitch.
        tilt_rate_rad_s: Most that roll and pitch change per second.
        yaw_rate_rad_s: Most that it turns.
        lag_s: Time constant of its attitude.
        drag_n_s_m: Linear drag, in newtons for each m/s.
        drag_n_s2_m2: Quadratic drag, in newtons for each m^2/s^2.
        speed_m_s: Most speed that its autopilot asks for, horizontally.
        climb_m_s: Most that it asks for downwards and upwards.
        acceleration_m_s2: Most acceleration that it asks for, horizontally.
        climb_m_s2: Most that it asks for downwards and upwards.
        gains_per_s: Acceleration for each m/s that is missing, horizontally and vertically.
        radius_m: Of the upright cylinder that contains it.
        height_m: Of that cylinder.
    """

    mass_kg: float
    thrust_n: tuple[float, float]
    tilt_rad: float
    tilt_rate_rad_s: float
    yaw_rate_rad_s: float
    lag_s: float
    drag_n_s_m: float
    drag_n_s2_m2: float
    speed_m_s: float
    climb_m_s: tuple[float, float]
    acceleration_m_s2: float
    climb_m_s2: tuple[float, float]
    gains_per_s: tuple[float, float]
    radius_m: float
    height_m: float

    def drag_m_s2(self, speed_m_s: float) -> float:
        """Return what drag takes from a speed per second."""
        return (self.drag_n_s_m + self.drag_n_s2_m2 * speed_m_s) * speed_m_s / self.mass_kg

    def drive_m_s2(self) -> float:
        """Return the most that thrust and gravity together change its velocity per second.

        Largest at the least or at the most thrust, by the law of cosines, with roll and pitch both as far as they go.
        """
        upright = math.cos(self.tilt_rad) ** 2
        return max(
            math.sqrt(f * f - 2 * f * GRAVITY_M_S2 * upright + GRAVITY_M_S2**2)
            for f in (thrust_n / self.mass_kg for thrust_n in self.thrust_n)
        )

    def top_speed_m_s(self) -> float:
        """Return the speed at which drag takes what drives it, however it flies."""
        a, b, c = self.drag_n_s2_m2, self.drag_n_s_m, self.drive_m_s2() * self.mass_kg
        return 2 * c / (b + math.sqrt(b * b + 4 * a * c))


IRIS: Final = QuadrotorLimits(
    mass_kg=1.5,
    thrust_n=(2.8, 28.27),
    tilt_rad=math.radians(45),
    tilt_rate_rad_s=math.radians(220),
    yaw_rate_rad_s=math.radians(200),
    lag_s=1 / 6.5,
    drag_n_s_m=0.556,
    drag_n_s2_m2=0.033,
    speed_m_s=12.0,
    climb_m_s=(1.5, 3.0),
    acceleration_m_s2=5.0,
    climb_m_s2=(3.0, 4.0),
    gains_per_s=(1.8, 4.0),
    radius_m=0.384,
    height_m=0.11,
)
"""3DR Iris as PX4's simulation has it (github.com/PX4/PX4-SITL_gazebo-classic, `models/iris`): 1.5 kg; four rotors of
5.84e-6 N/(rad/s)^2 up to 1100 rad/s, so 28.27 N; rotor drag 1.75e-4 N/(rad/s)/(m/s) at the 794 rad/s of hovering;
0.47 m x 0.47 m x 0.11 m, rotors of 0.128 m around (0.13, 0.22) m. Limits and gains are PX4's defaults (parameter
reference: MPC_TILTMAX_AIR, MC_ROLLRATE_MAX, MC_YAWRATE_MAX, 1 / MC_ROLL_P, MPC_XY_VEL_MAX, MPC_Z_VEL_MAX_DN and UP,
MPC_ACC_HOR_MAX, MPC_ACC_DOWN_MAX and UP, MPC_XY_VEL_P_ACC, MPC_Z_VEL_P_ACC). Least thrust is a tenth, ours; so is the
drag of the body, that of a cube's face of 0.47 m x 0.11 m: 1.225 kg/m^3 x 1.05 x 0.052 m^2 / 2."""

DUCKIEDRONE: Final = QuadrotorLimits(
    mass_kg=0.45,
    thrust_n=(0.9, 9.0),
    tilt_rad=math.radians(25),
    tilt_rate_rad_s=math.radians(120),
    yaw_rate_rad_s=math.radians(90),
    lag_s=0.2,
    drag_n_s_m=0.15,
    drag_n_s2_m2=0.01,
    speed_m_s=2.0,
    climb_m_s=(0.5, 0.5),
    acceleration_m_s2=2.0,
    climb_m_s2=(2.0, 2.0),
    gains_per_s=(1.2, 3.0),
    radius_m=0.2,
    height_m=0.12,
)
"""Duckietown Duckiedrone: a frame of the 250 mm class. No data sheet tells its flight; all these are our estimates,
from the mass of its parts and twice its weight in thrust, and slow, as it is flown indoors by a camera."""


class FlightPose(NamedTuple):
    """Where a quadrotor is and how it moves.

    Attributes:
        place_m: Metres east, north, up, of its lowest point.
        velocity_m_s: Metres per second east, north, up.
        roll_rad: Above 0 with its left side up.
        pitch_rad: Above 0 with its nose down.
        heading_rad: Where its nose points, from east towards north.
    """

    place_m: Vector
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    heading_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Glide:
    """A course at one velocity.

    Attributes:
        begin: Where it begins.
        velocity_m_s: Its velocity, which is that of `begin` but for rounding.
        step_s: How long a step is.
    """

    begin: FlightPose
    velocity_m_s: Vector
    step_s: float

    @property
    def steps(self) -> None:
        """See `Course.steps`."""

    @property
    def moves(self) -> bool:
        """See `Course.moves`."""
        return any(self.velocity_m_s)

    def at(self, steps: int) -> FlightPose:
        """See `Course.at`."""
        if not steps:
            return self.begin
        (e, n, u), (v_e, v_n, v_u) = self.begin.place_m, self.velocity_m_s
        t = steps * self.step_s
        return self.begin._replace(place_m=(e + t * v_e, n + t * v_n, u + t * v_u), velocity_m_s=self.velocity_m_s)


class Flight:
    """A course that changes from step to step; poses are worked out when they are asked for.

    Args:
        begin: Where it begins.
        autopilot: Flies it.
        wanted: What it shall do.
        step_s: How long a step is.
    """

    steps = _LONGEST
    moves = True

    def __init__(self, begin: FlightPose, autopilot: "VelocityController", wanted: Velocity, step_s: float) -> None:
        self._poses = [begin]
        self._autopilot = autopilot
        self._wanted = wanted
        self._step_s = step_s

    def at(self, steps: int) -> FlightPose:
        """See `Course.at`."""
        poses = self._poses
        while len(poses) <= steps:
            poses.append(self._autopilot.fly(poses[-1], self._wanted, self._step_s))
        return poses[steps]


class VelocityController:
    """Flies a quadrotor at a wanted velocity.

    Args:
        limits: Of the quadrotor.
    """

    def __init__(self, limits: QuadrotorLimits) -> None:
        self._limits = limits
        self._leans = math.tan(limits.tilt_rad)

    def thrust_m_s2(self, velocity_m_s: Vector, wanted: Velocity) -> Vector:
        """Return the thrust per mass that it wants, east, north, up."""
        limits = self._limits
        v_e, v_n, v_u = velocity_m_s
        to_e, to_n, to_u = wanted.velocity_m_s
        gain_per_s, climb_per_s = limits.gains_per_s
        a_e, a_n = _shortened(gain_per_s * (to_e - v_e), gain_per_s * (to_n - v_n), limits.acceleration_m_s2)
        a_u = _between(climb_per_s * (to_u - v_u), limits.climb_m_s2)
        drag_per_s = (limits.drag_n_s_m + limits.drag_n_s2_m2 * math.hypot(v_e, v_n, v_u)) / limits.mass_kg
        up = max(a_u + GRAVITY_M_S2 + drag_per_s * v_u, limits.thrust_n[0] / limits.mass_kg)
        east, north = _shortened(a_e + drag_per_s * v_e, a_n + drag_per_s * v_n, up * self._leans)
        return east, north, up

    def fly(self, pose: FlightPose, wanted: Velocity, step_s: float) -> FlightPose:
        """Return where it is a step later."""
        limits = self._limits
        (e, n, u), (v_e, v_n, v_u), roll, pitch, yaw = pose
        f_e, f_n, f_u = self.thrust_m_s2(pose.velocity_m_s, wanted)
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        forward, left = f_e * cos_yaw + f_n * sin_yaw, f_n * cos_yaw - f_e * sin_yaw
        share, most = -math.expm1(-step_s / limits.lag_s), limits.tilt_rate_rad_s * step_s
        pitch = _followed(pitch, math.atan2(forward, f_u), share, most)
        roll = _followed(roll, -math.atan2(left, math.hypot(forward, f_u)), share, most)
        if wanted.yaw_rad is not None:
            off_rad = math.remainder(wanted.yaw_rad - yaw, math.tau)
            yaw = _followed(yaw, yaw + off_rad, share, limits.yaw_rate_rad_s * step_s)
        # What it has: the wanted vertical part, as far as its bounds let it.
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


def _followed(now: float, target: float, share: float, most: float) -> float:
    return now + _clip(share * (target - now), -most, most)


def _clip(value: float, least: float, most: float) -> float:
    return max(least, min(value, most))


def _between(value: float, limits: tuple[float, float]) -> float:
    return _clip(value, -limits[0], limits[1])


def _shortened(one: float, other: float, most: float) -> tuple[float, float]:
    """Return a vector, shortened to a length if it is longer."""
    length = math.hypot(one, other)
    return (one, other) if length <= most else (one * most / length, other * most / length)


class Quadrotor:
    """A quadrotor that takes `Velocity` commands; without one it hovers.

    Args:
        limits: What it can do.
        place_m: Where it is at time 0, metres east, north, up.
        heading_rad: Where its nose points, from east towards north.
        antenna_m: Height of its antenna over its lowest point.
    """

    def __init__(
        self, limits: QuadrotorLimits, place_m: Vector, heading_rad: float = 0.0, *, antenna_m: float = 0.0
    ) -> None:
        self._limits = limits
        self._autopilot = VelocityController(limits)
        self._heading_rad = heading_rad
        self.place_m = place_m
        self.flies = True
        self.steepest = 0.0
        self.radius_m = limits.radius_m
        self.height_m = limits.height_m
        self.antenna_m = antenna_m
        self.top_speed_m_s = limits.top_speed_m_s()

    def begin(self) -> FlightPose:
        """See `Body.begin`."""
        return FlightPose(self.place_m, heading_rad=self._heading_rad)

    def placed(self, pose: FlightPose, surface: Surface) -> FlightPose:  # noqa: ARG002 (see Body)
        """See `Body.placed`: it flies."""
        return pose

    def course(self, pose: FlightPose, command: object, step_s: float) -> Glide | Flight:
        """See `Body.course`."""
        wanted = self._wanted(command)
        if self._is_steady(pose, wanted):
            return Glide(pose, wanted.velocity_m_s, step_s)
        return Flight(pose, self._autopilot, wanted, step_s)

    def stopped(self, pose: FlightPose, stop: ContactStop, command: object) -> FlightPose:  # noqa: ARG002 (see Body)
        """See `Body.stopped`: it keeps what its velocity has along what it touches."""
        return pose._replace(place_m=stop.place_m, velocity_m_s=stop.along(pose.velocity_m_s))

    def limit_m_s2(self, pose: FlightPose) -> float:
        """See `Body.limit_m_s2`.

        Drag grows with speed along it, so it never drives two velocities apart: what drag adds to how a velocity
        changes is bounded by the drag of now, however long it goes on.
        """
        return self._limits.drive_m_s2() + self._limits.drag_m_s2(math.hypot(*pose.velocity_m_s))

    def _wanted(self, command: object) -> Velocity:
        """Return a command within the limits."""
        if command is None:
            return Velocity()
        if not isinstance(command, Velocity) or not all(
            map(math.isfinite, (*command.velocity_m_s, command.yaw_rad or 0))
        ):
            raise ConfigurationError(
                f"a quadrotor cannot do {command!r}", remedy="command it by a Velocity of finite numbers"
            )
        east, north, up = command.velocity_m_s
        limits = self._limits
        return Velocity((*_shortened(east, north, limits.speed_m_s), _between(up, limits.climb_m_s)), command.yaw_rad)

    def _is_steady(self, pose: FlightPose, wanted: Velocity) -> bool:
        """Return whether it goes on for ever as it is wanted, but for rounding."""
        if math.dist(pose.velocity_m_s, wanted.velocity_m_s) > _SAME:
            return False
        then = self._autopilot.fly(pose, wanted, 1.0)
        changes = (abs(one - other) for one, other in zip(then[2:], pose[2:], strict=True))
        return max(changes) <= _SAME and math.dist(then.velocity_m_s, pose.velocity_m_s) <= _SAME
