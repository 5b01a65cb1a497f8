"""Masses and sizes of the robots in MuJoCo.

Positions are relative to the ground below the middle of a robot's wheels, or to the lowest point of a quadrotor:
metres forward, left, up.
"""

from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.physics.robot_limits import IRIS, TURTLEBOT3_BURGER, DriveLimits, QuadrotorLimits
from sim_backends.world.shapes import Box


@dataclass(frozen=True)
class Wheels:
    """Wheels of equal size; the wheels of the two sides may turn at different speeds.

    Attributes:
        axles_m: Positions of the axles, forward of the middle; each has a wheel on both sides.
        track_m: Distance between the left and the right wheels.
        turning_track_m: Difference of the speeds of the two sides per yaw rate, as assumed by the robot's controller.
        radius_m: Radius of a wheel.
        width_m: Width of a wheel.
        mass_kg: Mass of a wheel.
        torque_n_m: Maximum torque of the motor of a wheel.
    """

    axles_m: tuple[float, ...]
    track_m: float
    turning_track_m: float
    radius_m: float
    width_m: float
    mass_kg: float
    torque_n_m: float


@dataclass(frozen=True)
class Chassis:
    """A robot on wheels.

    Attributes:
        mass_kg: Mass without wheels.
        centre_m: Centre of mass without wheels.
        inertia_kg_m2: Moments of inertia without wheels, about the axes through this centre: forward, left, up.
        boxes: Its shape.
        wheels: Its wheels.
        caster_m: Lowest point of a caster without friction; None for a robot without a caster.
    """

    mass_kg: float
    centre_m: Vector
    inertia_kg_m2: Vector
    boxes: tuple[Box, ...]
    wheels: Wheels
    caster_m: Vector | None = None

    def scaled(self, factor: float) -> "Chassis":
        """Return a robot of the same shape and density, with lengths multiplied by a factor."""
        wheels = self.wheels
        return Chassis(
            self.mass_kg * factor**3,
            _scaled(self.centre_m, factor),
            _scaled(self.inertia_kg_m2, factor**5),
            tuple(Box(_scaled(box.centre_m, factor), _scaled(box.size_m, factor)) for box in self.boxes),
            Wheels(
                tuple(axle_m * factor for axle_m in wheels.axles_m),
                wheels.track_m * factor,
                wheels.turning_track_m * factor,
                wheels.radius_m * factor,
                wheels.width_m * factor,
                wheels.mass_kg * factor**3,
                wheels.torque_n_m * factor**4,
            ),
            None if self.caster_m is None else _scaled(self.caster_m, factor),
        )


def _scaled(vector: Vector, factor: float) -> Vector:
    return vector[0] * factor, vector[1] * factor, vector[2] * factor


HUSKY: Final = Chassis(
    mass_kg=46.034,
    centre_m=(0.0, 0.0, 0.194),
    inertia_kg_m2=(0.6022, 1.7386, 2.0296),
    boxes=(
        Box((0.0, 0.0, 0.1942), (0.9874, 0.5709, 0.1238)),
        Box((0.0, 0.0, 0.3080), (0.7899, 0.5709, 0.1038)),
    ),
    wheels=Wheels(
        axles_m=(0.256, -0.256),
        track_m=0.5708,
        turning_track_m=1.875 * 0.5708,
        radius_m=0.1651,
        width_m=0.1143,
        mass_kg=2.637,
        torque_n_m=46.0,
    ),
)
"""Clearpath Husky A200: `husky_description/urdf/husky.urdf.xacro` (github.com/husky/husky), with its centre of mass
in the plane of symmetry. Its controller multiplies the track by 1.875 (`husky_control/config/control.yaml`), because
the wheels slide sideways when it turns. With equal friction in all directions, a wheelbase a and a track b, the yaw
rate is b^2 / (a^2 + b^2) = 0.554 of the yaw rate of rolling wheels. The torque of its motors is not published; this
value is twice the friction of a wheel, so that friction is the limit.
"""

BURGER: Final = Chassis(
    mass_kg=0.940,
    centre_m=(-0.032, 0.0, 0.06),
    inertia_kg_m2=(2.2124e-3, 2.1194e-3, 2.0064e-3),
    boxes=(Box((-0.032, 0.0, 0.080), (0.140, 0.140, 0.140)),),
    wheels=Wheels(
        axles_m=(0.0,),
        track_m=0.160,
        turning_track_m=0.160,
        radius_m=0.033,
        width_m=0.018,
        mass_kg=0.0285,
        torque_n_m=1.4,
    ),
    caster_m=(-0.081, 0.0, 0.0),
)
"""ROBOTIS TurtleBot3 Burger: `turtlebot3_description/urdf/turtlebot3_burger.urdf.xacro`
(github.com/ROBOTIS-GIT/turtlebot3) with the mass of the laser scanner; the stall torque of its motors (XL430-W250,
e-Manual). Its centre of mass is not published; here it is in the middle of its body, because the robot would fall
over with the centre of mass of the URDF, which is above the axle.
"""

CASTER_RADIUS_M: Final = 0.01
"""Radius of the sphere that models a caster."""


def chassis(profile: str, limits: DriveLimits) -> Chassis:
    """Return the Husky's chassis for the profile `husky`, otherwise a TurtleBot3 Burger of the robot's radius."""
    if profile == "husky":
        return HUSKY
    factor = limits.radius_m / TURTLEBOT3_BURGER.radius_m
    return BURGER if factor == 1 else BURGER.scaled(factor)


_IRIS_INERTIA_KG_M2: Final = (0.029125, 0.029125, 0.055225)


def quadrotor_inertia_kg_m2(limits: QuadrotorLimits) -> Vector:
    """Return the moments of inertia of a quadrotor, scaled from PX4's Iris (`models/iris`) by mass and size."""
    factor = limits.mass_kg / IRIS.mass_kg * (limits.radius_m / IRIS.radius_m) ** 2
    return _scaled(_IRIS_INERTIA_KG_M2, factor)
