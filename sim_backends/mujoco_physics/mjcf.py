"""The model of a run in MJCF, MuJoCo's XML: world, robots, motors and sensors.

Elements are named by the numbers of agents, because names of agents may have any characters. The sensors of an agent
are, in this order, the position and velocity of its antenna and its forward and left directions: 12 numbers.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree as ET

from fieldkit.core.model import Vector
from sim_backends.mujoco_physics.chassis import CASTER_RADIUS_M, Chassis, quadrotor_inertia_kg_m2
from sim_backends.physics.robot_limits import QuadrotorLimits
from sim_backends.world.motion import GRAVITY_M_S2
from sim_backends.world.obstacles import Raised, Ramp
from sim_backends.world.shapes import Box, Shape
from sim_backends.world.world import World

SENSED_NUMBERS: Final = 12
"""Number of values of the sensors of an agent."""
WHEEL_CONTROL_PER_S: Final = 40.0
"""Natural frequency of the speed control of a wheel. The control is critically damped, and lags its set-point by 0.05
s."""
BODY_RATE_CONTROL_PER_S: Final = 30.0
"""Bandwidth of the control of a quadrotor's roll, pitch and yaw rates."""
_CONTACT: Final = {"solref": "0.01 1", "solimp": "0.9 0.95 0.001"}
"""Softness of contacts of bodies, which have no friction, as in the built-in physics."""
_GRIP: Final = {"solref": "0.003 1.6", "solimp": "0.1 0.1 0.001"}
"""Softness of contacts with the ground; a Husky compresses its tires by 0.3 mm."""
_GRIP_SLIP: Final = "0.3 1"
"""Softness of the friction of these contacts. MuJoCo's contacts repel a sliding body in proportion to its speed; if
the friction were stiffer, the wheels of a robot that turns would hop (documentation of MuJoCo, "Computation", convex
relaxation)."""
_BODY_FRICTION: Final = 0.3
"""Friction of a robot that has fallen over; an estimate without a source."""
_IMPEDANCE_RATIO: Final = 10_000.0
"""MuJoCo's `impratio`: impedance of the friction divided by impedance of the normal force of a contact. With this
value a robot at rest on a slope of 20 degrees slides by at most 0.02 mm/s."""


@dataclass(frozen=True)
class RobotModel:
    """A robot in the model of a run.

    Attributes:
        place_m: Position of its lowest point at time 0, metres east, north, up.
        quaternion: Its orientation at time 0.
        antenna_m: Height of its antenna above its position.
        friction: Coefficient of friction of its tires; 0 for a quadrotor.
        body: Its masses and sizes.
    """

    place_m: Vector
    quaternion: tuple[float, float, float, float]
    antenna_m: float
    friction: float
    body: Chassis | QuadrotorLimits


def quaternion(yaw_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0) -> tuple[float, float, float, float]:
    """Return the rotation by roll about the forward axis, then pitch about left (nose down), then yaw about up."""
    cos_y, sin_y = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    cos_p, sin_p = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cos_r, sin_r = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    return (
        cos_y * cos_p * cos_r + sin_y * sin_p * sin_r,
        cos_y * cos_p * sin_r - sin_y * sin_p * cos_r,
        cos_y * sin_p * cos_r + sin_y * cos_p * sin_r,
        sin_y * cos_p * cos_r - cos_y * sin_p * sin_r,
    )


def model_xml(robots: Sequence[RobotModel], world: World | None, timestep_s: float) -> str:
    """Return the model of a run in MJCF.

    Args:
        robots: The robots, by number.
        world: Ground and obstacles; None for open flat ground.
        timestep_s: MuJoCo's time step.
    """
    document = _Document(timestep_s)
    document.add_world(world)
    for number, robot in enumerate(robots):
        document.add_robot(number, robot)
    return ET.tostring(document.root, encoding="unicode")


def _add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    return ET.SubElement(parent, tag, attributes)


def _text(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


class _Document:
    """The XML document of a model, to which elements are added.

    Args:
        timestep_s: MuJoCo's time step.

    Attributes:
        root: Its root.
    """

    def __init__(self, timestep_s: float) -> None:
        self.root = root = ET.Element("mujoco")
        _add(root, "compiler", angle="radian", autolimits="true")
        option = _add(
            root,
            "option",
            timestep=repr(timestep_s),
            gravity=_text((0.0, 0.0, -GRAVITY_M_S2)),
            integrator="implicitfast",
            cone="elliptic",
            impratio=repr(_IMPEDANCE_RATIO),
        )
        _add(option, "flag", autoreset="disable")
        _add(_add(root, "default"), "geom", condim="1", **_CONTACT)
        self._meshes, self._bodies = _add(root, "asset"), _add(root, "worldbody")
        self._grips = _add(root, "contact")
        self._motors, self._sensors = _add(root, "actuator"), _add(root, "sensor")
        self._grounds: list[str] = []

    def add_world(self, world: World | None) -> None:
        """Add ground and obstacles."""
        _add(self._bodies, "geom", name=self._new_ground(), type="plane", size="0 0 1")
        for obstacle in world.obstacles if world is not None else ():
            if isinstance(obstacle, Ramp):
                self._add_ramp(obstacle)
                continue
            for part in obstacle.parts():
                name = {"name": self._new_ground()} if isinstance(obstacle, Raised) else {}
                _add_shape(self._bodies, part.shape, **name)

    def add_robot(self, number: int, robot: RobotModel) -> None:
        """Add a robot, with its motors and sensors."""
        name = f"a{number}"
        body = _add(self._bodies, "body", name=name, pos=_text(robot.place_m), quat=_text(robot.quaternion))
        _add(body, "freejoint", name=name)
        _add(body, "site", name=name, pos=_text((0.0, 0.0, robot.antenna_m)))
        if isinstance(robot.body, Chassis):
            self._add_vehicle(body, name, robot.body, robot.friction)
        else:
            self._add_quadrotor(body, name, robot.body)
        for kind in ("framepos", "framelinvel", "framexaxis", "frameyaxis"):
            _add(self._sensors, kind, objtype="site", objname=name)

    def _new_ground(self) -> str:
        self._grounds.append(f"ground{len(self._grounds)}")
        return self._grounds[-1]

    def _add_ramp(self, ramp: Ramp) -> None:
        name = self._new_ground()
        long_m, wide_m, high_m = ramp.size_m
        corners_m: list[float] = []
        for across_m in (-wide_m / 2, wide_m / 2):
            for along_m, up_m in ((-long_m / 2, 0.0), (long_m / 2, 0.0), (long_m / 2, high_m)):
                corners_m += (along_m, across_m, up_m)
        _add(self._meshes, "mesh", name=name, vertex=_text(corners_m))
        position, rotation = _text((*ramp.centre_m, 0.0)), _text(quaternion(math.radians(ramp.yaw_deg)))
        _add(self._bodies, "geom", name=name, type="mesh", mesh=name, pos=position, quat=rotation)

    def _add_vehicle(self, body: ET.Element, name: str, chassis: Chassis, friction: float) -> None:
        _add_inertia(body, chassis.mass_kg, chassis.centre_m, chassis.inertia_kg_m2)
        for index, box in enumerate(chassis.boxes):
            shape = f"{name}b{index}"
            _add_shape(body, box, name=shape)
            self._add_grip(shape, _BODY_FRICTION)
        if chassis.caster_m is not None:
            forward_m, left_m, up_m = chassis.caster_m
            position = _text((forward_m, left_m, up_m + CASTER_RADIUS_M))
            _add(body, "geom", type="sphere", size=repr(CASTER_RADIUS_M), pos=position)
        for side, letter in ((1, "l"), (-1, "r")):
            for axle, forward_m in enumerate(chassis.wheels.axles_m):
                at_m = (forward_m, side * chassis.wheels.track_m / 2, chassis.wheels.radius_m)
                self._add_wheel(body, f"{name}{letter}{axle}", at_m, chassis, friction)

    def _add_wheel(self, body: ET.Element, name: str, at_m: Vector, chassis: Chassis, friction: float) -> None:
        """Add a wheel and its motor, which controls its speed."""
        wheels = chassis.wheels
        wheel = _add(body, "body", pos=_text(at_m))
        _add(wheel, "joint", name=name, type="hinge", axis="0 1 0")
        # An ellipsoid has one contact with flat ground, below its centre; a cylinder would have four.
        size = _text((wheels.radius_m, wheels.width_m / 2, wheels.radius_m))
        _add(wheel, "geom", name=name, type="ellipsoid", size=size, mass=repr(wheels.mass_kg))
        self._add_grip(name, friction)
        # The motor also accelerates the robot. Its share of the robot's mass acts at the radius of the wheel.
        count = 2 * len(wheels.axles_m)
        inertia_kg_m2 = (chassis.mass_kg / count + wheels.mass_kg) * wheels.radius_m**2
        stiffness, damping = inertia_kg_m2 * WHEEL_CONTROL_PER_S**2, 2 * inertia_kg_m2 * WHEEL_CONTROL_PER_S
        # The activation is the integral of the set-point of the speed, so the motor also controls the wheel's angle.
        _add(
            self._motors,
            "general",
            name=name,
            joint=name,
            dyntype="integrator",
            gainprm=repr(stiffness),
            biastype="affine",
            biasprm=_text((0.0, -stiffness, -damping)),
            forcerange=_text((-wheels.torque_n_m, wheels.torque_n_m)),
        )

    def _add_grip(self, name: str, friction: float) -> None:
        """Add contacts with friction between a shape and the ground, ramps and raised floors.

        Contacts with other obstacles have no friction.
        """
        for ground in self._grounds:
            # `condim="3"` uses only the first two coefficients, for sliding; the others are MuJoCo's defaults.
            _add(
                self._grips,
                "pair",
                geom1=ground,
                geom2=name,
                condim="3",
                friction=_text((friction, friction, 0.005, 0.0001, 0.0001)),
                solreffriction=_GRIP_SLIP,
                **_GRIP,
            )

    def _add_quadrotor(self, body: ET.Element, name: str, limits: QuadrotorLimits) -> None:
        """Add a quadrotor: thrust along its axis, and torques that turn it to the attitude of a body without mass."""
        inertia_kg_m2, centre_m = quadrotor_inertia_kg_m2(limits), (0.0, 0.0, limits.height_m / 2)
        _add_inertia(body, limits.mass_kg, centre_m, inertia_kg_m2)
        # A cylinder that turns on a plane has wrong contacts, 0.4 m deep, in MuJoCo 4.0.1.
        half_axes_m = (limits.radius_m, limits.radius_m, limits.height_m / 2)
        shape = f"{name}b"
        _add(body, "geom", name=shape, type="ellipsoid", size=_text(half_axes_m), pos=_text(centre_m))
        self._add_grip(shape, _BODY_FRICTION)
        centre, target = f"{name}c", f"{name}t"
        _add(body, "site", name=centre, pos=_text(centre_m))
        attitude = _add(self._bodies, "body", name=target, mocap="true", quat=body.attrib["quat"])
        _add(attitude, "site", name=target)
        thrust = _text((0.0, limits.thrust_n[1]))  # 0 while the rotors are off
        _add(self._motors, "general", name=name, site=centre, gear="0 0 1 0 0 0", ctrlrange=thrust)
        for axis, moment_kg_m2 in enumerate(inertia_kg_m2, start=3):
            damping = moment_kg_m2 * BODY_RATE_CONTROL_PER_S
            _add(
                self._motors,
                "general",
                site=centre,
                refsite=target,
                gear=_text(float(index == axis) for index in range(6)),
                gainprm="0",
                biastype="affine",
                biasprm=_text((0.0, -damping / limits.lag_s, -damping)),
            )


def _add_shape(parent: ET.Element, shape: Shape, **attributes: str) -> None:
    position = _text(shape.centre_m)
    if isinstance(shape, Box):
        size, rotation = _text(edge_m / 2 for edge_m in shape.size_m), _text(quaternion(shape.yaw_rad))
        _add(parent, "geom", type="box", size=size, pos=position, quat=rotation, **attributes)
    else:
        size = _text((shape.radius_m, shape.height_m / 2))
        _add(parent, "geom", type="cylinder", size=size, pos=position, **attributes)


def _add_inertia(body: ET.Element, mass_kg: float, centre_m: Vector, inertia_kg_m2: Vector) -> None:
    _add(body, "inertial", mass=repr(mass_kg), pos=_text(centre_m), diaginertia=_text(inertia_kg_m2))
