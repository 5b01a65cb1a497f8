"""SDF worlds for Gazebo: obstacles of a world file and the robots of a scenario (sdformat.org, version 1.9).

The frame of a robot's model is at the lowest point of its vertical axis, where the built-in physics has its body.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, get_args
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fieldkit.core.model import Vector
from sim_backends.physics.robot_limits import HUSKY_A200, TURTLEBOT3_BURGER, DriveLimits, QuadrotorLimits
from sim_backends.world.motion import GRAVITY_M_S2
from sim_backends.world.obstacles import Obstacle, Ramp
from sim_backends.world.shapes import Box, Cylinder, Shape
from sim_backends.world.world import World

Version = Literal["fortress", "garden"]
"""Names of the plugins: the names of Fortress, or the names of Garden, which later versions also accept."""

VERSIONS: Final[tuple[Version, ...]] = get_args(Version)

REAL_TIME_FACTOR: Final = 5.0
"""Maximum real-time factor. A paused Gazebo repeats its loop at the same rate, so a larger factor needs more
processor time."""
POSE_HZ: Final = 2000
"""Largest rate of poses in wall time; at the default of 60 Hz each window takes up to 17 ms."""
_SLAB_M: Final = 0.1
"""Thickness of the slab of a ramp."""
_WHEEL_MASS_SHARE: Final = 0.05
"""Mass of a wheel as a share of the robot's mass."""
_ORIGIN_M: Final = (0.0, 0.0, 0.0)
_UPRIGHT: Final = (0.0, 0.0, 0.0)
_WHEEL_AXIS: Final = (-math.pi / 2, 0.0, 0.0)
"""Roll, pitch and yaw of an upright body, and of a wheel, whose axle is the z axis of its link."""


@dataclass(frozen=True)
class SdfRobot:
    """A robot of an SDF world.

    Attributes:
        limits: Limits and size of its body.
        place_m: Its position: the lowest point on its vertical axis.
        heading_rad: Its heading, from east towards north.
    """

    limits: DriveLimits | QuadrotorLimits
    place_m: Vector
    heading_rad: float


@dataclass(frozen=True)
class _Chassis:
    """Geometry of a robot with wheels.

    Attributes:
        length_m: Length of its box.
        width_m: Width of its box, between the wheels.
        clearance_m: Height of the underside.
        wheel_radius_m: Radius of its wheels.
        wheel_width_m: Width of its wheels.
        track_m: Distance between left and right wheels.
        base_m: Distance between front and rear wheels; 0 for two wheels with a ball caster in front and behind.
        mass_kg: Mass of the robot with its wheels.
        lateral_friction: Coefficient of friction along the axle: four wheels must slide sideways in turns.
    """

    length_m: float
    width_m: float
    clearance_m: float
    wheel_radius_m: float
    wheel_width_m: float
    track_m: float
    base_m: float
    mass_kg: float
    lateral_friction: float


_HUSKY: Final = _Chassis(0.99, 0.42, 0.13, 0.165, 0.114, 0.57, 0.512, 46.0, 0.1)
"""Clearpath Husky A200: data sheet; wheels of `husky_description/urdf/husky.urdf.xacro` (github.com/husky/husky)."""
_TURTLEBOT: Final = _Chassis(0.138, 0.13, 0.01, 0.033, 0.018, 0.16, 0.0, 1.0, 0.8)
"""ROBOTIS TurtleBot3 Burger: e-Manual, and `turtlebot3_burger.urdf` (github.com/ROBOTIS-GIT/turtlebot3)."""


def world_sdf(
    world: World, robots: Mapping[str, SdfRobot], *, step_ns: int = 1_000_000, version: Version = "fortress"
) -> str:
    """Return the text of an SDF file with a world and its robots.

    Args:
        world: The world.
        robots: Its robots by name; the model of a robot has the same name.
        step_ns: Physics step.
        version: Version of Gazebo, which determines the names of the plugins.
    """
    root = Element("sdf", version="1.9")
    element = SubElement(root, "world", name=world.name)
    physics = SubElement(element, "physics", name="fieldkit", type="ignored")
    _add_texts(physics, max_step_size=step_ns / 1e9, real_time_factor=REAL_TIME_FACTOR)
    SubElement(element, "gravity").text = f"0 0 {-GRAVITY_M_S2}"
    _add_plugin(element, version, "Physics", "physics")
    _add_plugin(element, version, "UserCommands", "user-commands")
    _add_texts(_add_plugin(element, version, "SceneBroadcaster", "scene-broadcaster"), dynamic_pose_hertz=POSE_HZ)
    _add_command_reply(element, world, version)
    sun = SubElement(element, "light", type="directional", name="sun")
    _add_texts(sun, cast_shadows="true", pose="0 0 20 0 0 0", direction="-0.5 0.1 -0.9", diffuse="0.8 0.8 0.8 1")
    ground = _static_model(element, "ground_plane")
    # The plane's centre is the origin, a corner of the area, so it must be more than twice as large as the area.
    for kind in ("collision", "visual"):
        geometry = SubElement(SubElement(ground, kind, name=kind), "geometry")
        _add_texts(
            SubElement(geometry, "plane"), normal="0 0 1", size="{:g} {:g}".format(*(4 * m for m in world.area_m))
        )
    for obstacle in world.obstacles:
        _add_obstacle(element, obstacle)
    for name, robot in robots.items():
        _add_robot(element, name, robot, version, step_ns)
    indent(root)
    return '<?xml version="1.0"?>\n' + tostring(root, encoding="unicode") + "\n"


def model_sdf(name: str, limits: DriveLimits | QuadrotorLimits, *, step_ns: int, version: Version) -> str:
    """Return the text of an SDF file with one robot at the origin, from which Gazebo creates the robot's model.

    The arguments are those of `world_sdf`.
    """
    root = Element("sdf", version="1.9")
    _add_robot(root, name, SdfRobot(limits, _ORIGIN_M, 0.0), version, step_ns)
    return tostring(root, encoding="unicode")


def _add_command_reply(parent: Element, world: World, version: Version) -> None:
    """Add a plugin that answers the message after the commands of a window; the answer proves their reception."""
    plugin = _add_plugin(parent, version, "TriggeredPublisher", "triggered-publisher")
    kind = "ignition.msgs.Empty" if version == "fortress" else "gz.msgs.Empty"
    for tag, topic in (("input", "fence"), ("output", "passed")):
        SubElement(plugin, tag, type=kind, topic=f"/world/{world.name}/fieldkit/{topic}")


def _add_plugin(parent: Element, version: Version, name: str, file: str) -> Element:
    library, namespace = ("ignition-gazebo", "ignition::gazebo") if version == "fortress" else ("gz-sim", "gz::sim")
    return SubElement(parent, "plugin", filename=f"{library}-{file}-system", name=f"{namespace}::systems::{name}")


def _add_texts(parent: Element, /, **values: float | str) -> None:
    for key, value in values.items():
        SubElement(parent, key).text = value if isinstance(value, str) else f"{value:.9g}"


def _add_pose(parent: Element, position_m: Vector, angles_rad: Vector = _UPRIGHT) -> None:
    SubElement(parent, "pose").text = " ".join(f"{value:.9g}" for value in (*position_m, *angles_rad))


def _static_model(world: Element, name: str) -> Element:
    model = SubElement(world, "model", name=name)
    SubElement(model, "static").text = "true"
    return SubElement(model, "link", name="link")


def _add_obstacle(world: Element, obstacle: Obstacle) -> None:
    """Add a static model with the shapes of an obstacle."""
    link = _static_model(world, obstacle.name)
    if isinstance(obstacle, Ramp):
        _add_ramp(link, obstacle)
        return
    for number, part in enumerate(obstacle.parts()):
        yaw_rad = part.shape.yaw_rad if isinstance(part.shape, Box) else 0.0
        _add_shape(link, f"part-{number}", part.shape, part.shape.centre_m, (0.0, 0.0, yaw_rad))


def _add_ramp(link: Element, ramp: Ramp) -> None:
    """Add a ramp as a slab whose upper face is the slope, because wheels need an even surface."""
    (long_m, wide_m, high_m), yaw_rad = ramp.size_m, math.radians(ramp.yaw_deg)
    pitch_rad, slope_m = math.atan2(high_m, long_m), math.hypot(long_m, high_m)
    offset_m = _SLAB_M / 2 * math.sin(pitch_rad)  # horizontal, because the centre is below the upper face
    centre_m = (
        ramp.centre_m[0] + offset_m * math.cos(yaw_rad),
        ramp.centre_m[1] + offset_m * math.sin(yaw_rad),
        high_m / 2 - _SLAB_M / 2 * math.cos(pitch_rad),
    )
    _add_shape(link, "slab", Box(centre_m, (slope_m, wide_m, _SLAB_M)), centre_m, (0.0, -pitch_rad, yaw_rad))


def _add_shape(
    link: Element,
    name: str,
    shape: Shape,
    position_m: Vector,
    angles_rad: Vector = _UPRIGHT,
    *,
    frictions: tuple[float, float] | None = None,
) -> None:
    """Add a shape that collides and is visible.

    Args:
        link: Its link.
        name: Its name.
        shape: Its size; its position and rotation are ignored.
        position_m: Its centre in the frame of the link.
        angles_rad: Roll, pitch and yaw in that frame.
        frictions: Coefficients of friction along the z axis of the link and across it; None for the default.
    """
    for kind in ("collision", "visual"):
        element = SubElement(link, kind, name=f"{name}-{kind}")
        _add_pose(element, position_m, angles_rad)
        geometry = SubElement(element, "geometry")
        if isinstance(shape, Cylinder):
            _add_texts(SubElement(geometry, "cylinder"), radius=shape.radius_m, length=shape.height_m)
        else:
            _add_texts(SubElement(geometry, "box"), size=" ".join(f"{size:.9g}" for size in shape.size_m))
        if kind == "collision" and frictions is not None:
            ode = SubElement(SubElement(SubElement(element, "surface"), "friction"), "ode")
            _add_texts(ode, mu=frictions[0], mu2=frictions[1], fdir1="0 0 1")


def _add_inertia(link: Element, mass_kg: float, size_m: Vector, position_m: Vector = (0.0, 0.0, 0.0)) -> None:
    """Add the mass and the inertia of a homogeneous box of this size."""
    x, y, z = (size * size * mass_kg / 12 for size in size_m)
    inertial = SubElement(link, "inertial")
    _add_pose(inertial, position_m)
    _add_texts(inertial, mass=mass_kg)
    _add_texts(SubElement(inertial, "inertia"), ixx=y + z, iyy=x + z, izz=x + y, ixy=0.0, ixz=0.0, iyz=0.0)


def _add_robot(world: Element, name: str, robot: SdfRobot, version: Version, step_ns: int) -> None:
    model = SubElement(world, "model", name=name)
    _add_pose(model, robot.place_m, (0.0, 0.0, robot.heading_rad))
    if isinstance(robot.limits, DriveLimits):
        _add_drive(model, robot.limits, version)
    else:
        _add_quadrotor(model, robot.limits, version, step_ns)


def _chassis_of(limits: DriveLimits) -> _Chassis:
    """Return the geometry of the Husky for a body of its radius, otherwise a TurtleBot scaled to that radius."""
    if limits.radius_m == HUSKY_A200.radius_m:
        return _HUSKY
    scale = limits.radius_m / TURTLEBOT3_BURGER.radius_m
    lengths = {name: value * scale for name, value in vars(_TURTLEBOT).items() if name.endswith("_m")}
    return _Chassis(**{**vars(_TURTLEBOT), **lengths, "mass_kg": _TURTLEBOT.mass_kg * scale**3})


def _add_drive(model: Element, limits: DriveLimits, version: Version) -> None:
    """Add the chassis, the wheels and the plugin of a robot with wheels."""
    chassis = _chassis_of(limits)
    size_m = (chassis.length_m, chassis.width_m, limits.height_m - chassis.clearance_m)
    link = SubElement(model, "link", name="chassis")
    wheels = [(side, end) for side in (1, -1) for end in ((1, -1) if chassis.base_m else (0,))]
    chassis_kg = chassis.mass_kg - _WHEEL_MASS_SHARE * chassis.mass_kg * len(wheels)
    # The centre of mass is at a quarter of the box's height, because batteries and motors are at the bottom.
    _add_inertia(link, chassis_kg, size_m, (0.0, 0.0, chassis.clearance_m + size_m[2] / 4))
    _add_shape(link, "box", Box(_ORIGIN_M, size_m), (0.0, 0.0, chassis.clearance_m + size_m[2] / 2))
    if not chassis.base_m:
        _add_casters(link, chassis)
    for side, end in wheels:
        _add_wheel(model, chassis, limits.friction, side, end)
    plugin = _add_plugin(model, version, "DiffDrive", "diff-drive")
    for side, end in wheels:
        SubElement(plugin, "left_joint" if side > 0 else "right_joint").text = _wheel_name(side, end)
    _add_texts(
        plugin,
        wheel_separation=chassis.track_m,
        wheel_radius=chassis.wheel_radius_m,
        max_linear_velocity=limits.speed_m_s,
        min_linear_velocity=-limits.speed_m_s,
        max_angular_velocity=limits.turn_rad_s,
        min_angular_velocity=-limits.turn_rad_s,
        max_linear_acceleration=limits.acceleration_m_s2,
        min_linear_acceleration=-limits.acceleration_m_s2,
        max_angular_acceleration=limits.turn_acceleration_rad_s2,
        min_angular_acceleration=-limits.turn_acceleration_rad_s2,
    )


def _wheel_name(side: int, end: int) -> str:
    """Return the name of a wheel.

    Args:
        side: 1 for the left side, -1 for the right side.
        end: 1 for the front, -1 for the rear, 0 for the only wheel of a side.
    """
    end_text = {1: "-front", -1: "-rear", 0: ""}[end]
    return f"{'left' if side > 0 else 'right'}{end_text}-wheel"


def _add_wheel(model: Element, chassis: _Chassis, friction: float, side: int, end: int) -> None:
    """Add a wheel and its joint; see `_wheel_name` for `side` and `end`."""
    name = _wheel_name(side, end)
    link = SubElement(model, "link", name=f"{name}-link")
    radius_m, width_m = chassis.wheel_radius_m, chassis.wheel_width_m
    _add_pose(link, (end * chassis.base_m / 2, side * chassis.track_m / 2, radius_m), _WHEEL_AXIS)
    # A box whose edge is sqrt(3) = 1.7 times the radius has the inertia of the cylinder.
    _add_inertia(link, _WHEEL_MASS_SHARE * chassis.mass_kg, (1.7 * radius_m, 1.7 * radius_m, width_m))
    cylinder = Cylinder(_ORIGIN_M, radius_m, width_m)
    _add_shape(link, "tire", cylinder, _ORIGIN_M, frictions=(chassis.lateral_friction, friction))
    joint = SubElement(model, "joint", name=name, type="revolute")
    _add_texts(joint, parent="chassis", child=f"{name}-link")
    axis = SubElement(joint, "axis")
    _add_texts(axis, xyz="0 0 1")
    _add_texts(SubElement(axis, "limit"), lower=-1e16, upper=1e16)  # no limit of the angle


def _add_casters(link: Element, chassis: _Chassis) -> None:
    """Add a ball without friction in front and one behind, as high as the underside."""
    radius_m = chassis.clearance_m / 2
    for number, end in enumerate((1, -1)):
        element = SubElement(link, "collision", name=f"caster-{number}")
        _add_pose(element, (end * (chassis.length_m / 2 - radius_m), 0.0, radius_m))
        _add_texts(SubElement(SubElement(element, "geometry"), "sphere"), radius=radius_m)
        _add_texts(SubElement(SubElement(SubElement(element, "surface"), "friction"), "ode"), mu=0.0, mu2=0.0)


def _add_quadrotor(model: Element, limits: QuadrotorLimits, version: Version, step_ns: int) -> None:
    """Add a flying body that follows velocities; its thrust is not simulated."""
    edge_m = math.sqrt(2) * limits.radius_m
    link = SubElement(model, "link", name="body")
    centre_m = (0.0, 0.0, limits.height_m / 2)
    _add_inertia(link, limits.mass_kg, (edge_m, edge_m, limits.height_m), centre_m)
    _add_shape(link, "hull", Cylinder(_ORIGIN_M, limits.radius_m, limits.height_m), centre_m)
    plugin = _add_plugin(model, version, "VelocityControl", "velocity-control")
    # The plugin sets the velocity before each step, and gravity reduces it within the step.
    _add_texts(plugin, initial_linear=f"0 0 {GRAVITY_M_S2 * step_ns / 1e9:.9g}")
