"""SDF worlds have the obstacles of the world file and the robots of the scenario; a missing library is reported."""

import math
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import pytest

from fieldkit.cli import main
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim import load_scenario
from sim_backends.cosim.scenario.sdf_world import scenario_sdf
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.named import command_line
from sim_backends.gazebo.sdf import SdfRobot, world_sdf
from sim_backends.physics.robot_limits import TURTLEBOT3_BURGER
from sim_backends.world.obstacles import Ramp
from sim_backends.world.shapes import Box
from sim_backends.world.world import World, load_world


def numbers(element: Element, path: str) -> list[float]:
    text = element.findtext(path)
    assert text is not None, path
    return [float(word) for word in text.split()]


def collisions(model: Element) -> Iterator[tuple[list[float], list[float]]]:
    """Yield pose and size of each collision of a model: edges of a box, radius and length of a cylinder."""
    for collision in model.iter("collision"):
        geometry = collision.find("geometry")
        assert geometry is not None
        size = (
            numbers(geometry, "box/size")
            if geometry.find("box") is not None
            else [*numbers(geometry, "cylinder/radius"), *numbers(geometry, "cylinder/length")]
        )
        yield numbers(collision, "pose"), size


def test_obstacles_are_those_of_the_world_file() -> None:
    world = load_world("baylands")
    models = {
        model.attrib["name"]: model for model in fromstring(scenario_sdf(load_scenario("convoy"))).iter("model")
    }
    for obstacle in world.obstacles:
        model = models[obstacle.name]
        assert model.findtext("static") == "true"
        for part, (pose, size) in zip(obstacle.parts(), collisions(model), strict=True):
            shape = part.shape
            assert pose[:3] == pytest.approx(shape.centre_m)
            if isinstance(shape, Box):
                assert size == pytest.approx(shape.size_m)
                assert pose[3:] == pytest.approx([0, 0, shape.yaw_rad])
            else:
                assert size == pytest.approx([shape.radius_m, shape.height_m])


def test_a_ramp_rises_along_its_first_edge() -> None:
    ramp = Ramp.model_validate(
        {"kind": "ramp", "name": "ramp", "centre_m": [10, 20], "size_m": [4.0, 2.0, 1.0], "yaw_deg": 90.0}
    )
    world = World(name="hill", summary="", area_m=(50, 50), obstacles=(ramp,))
    ((pose, size),) = collisions(next(fromstring(world_sdf(world, {})).iterfind("world/model[@name='ramp']")))
    pitch_rad, yaw_rad = -pose[4], pose[5]
    assert size[0] == pytest.approx(math.hypot(4.0, 1.0))
    assert yaw_rad == pytest.approx(math.pi / 2)
    for position, height_m in ((-1, 0.0), (0, 0.5), (1, 1.0)):  # points of its upper side, before the turn by yaw
        along_m = position * size[0] / 2 * math.cos(pitch_rad) - size[2] / 2 * math.sin(pitch_rad)
        up_m = position * size[0] / 2 * math.sin(pitch_rad) + size[2] / 2 * math.cos(pitch_rad)
        assert pose[1] + along_m == pytest.approx(20 + 2.0 * position, abs=1e-6)
        assert pose[2] + up_m == pytest.approx(height_m, abs=1e-6)


def test_robots_are_at_their_starts_with_their_plugins() -> None:
    world = fromstring(scenario_sdf(load_scenario("convoy", {"physics.step": "2ms", "policy.window": "2ms"})))
    models = {model.attrib["name"]: model for model in world.iter("model")}
    assert numbers(models["leader"], "pose") == [20, 12, 0, 0, 0, 0]
    assert numbers(models["drone"], "pose") == [19, 12, 8, 0, 0, 0]
    drive = models["leader"].find("plugin[@name='ignition::gazebo::systems::DiffDrive']")
    assert drive is not None
    joints = {joint.attrib["name"] for joint in models["leader"].iter("joint")}
    driven_joints = {element.text for side in ("left_joint", "right_joint") for element in drive.iter(side)}
    assert driven_joints == joints
    assert len(joints) == 4
    # The velocity before a step compensates the fall in it.
    fly = models["drone"].find("plugin[@name='ignition::gazebo::systems::VelocityControl']")
    assert fly is not None
    assert numbers(fly, "initial_linear") == pytest.approx([0, 0, 9.80665 * 0.002])
    assert numbers(world, "world/physics/max_step_size") == [0.002]


def test_a_robot_with_two_wheels_touches_the_ground() -> None:
    robot = SdfRobot(TURTLEBOT3_BURGER, (1.0, 2.0, 0.0), 0.5)
    model = next(fromstring(world_sdf(load_world("open"), {"burger": robot})).iterfind("world/model[@name='burger']"))
    for link in model.iterfind("link"):
        if link.attrib["name"] != "chassis":
            assert numbers(link, "pose")[2] == numbers(link, "collision/geometry/cylinder/radius")[0]
    spheres = [collision for collision in model.iter("collision") if collision.find("geometry/sphere") is not None]
    for caster in spheres:
        assert numbers(caster, "pose")[2] == numbers(caster, "geometry/sphere/radius")[0]
    assert len(spheres) == 2


def test_the_command_prints_the_plugins_of_a_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cosim", "sdf", "convoy", "--gazebo", "garden"]) == 0
    world = fromstring(capsys.readouterr().out)
    files = {plugin.attrib["filename"] for plugin in world.iter("plugin")}
    assert files == {
        "gz-sim-physics-system",
        "gz-sim-user-commands-system",
        "gz-sim-scene-broadcaster-system",
        "gz-sim-triggered-publisher-system",
        "gz-sim-diff-drive-system",
        "gz-sim-velocity-control-system",
    }


def test_missing_libraries_are_reported_with_the_command_that_installs_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PKG_CONFIG_LIBDIR", str(tmp_path))
    monkeypatch.delenv("PKG_CONFIG_PATH", raising=False)
    with pytest.raises(
        ConfigurationError, match="gazebo-adapter needs the library ignition-transport11"
    ) as error_info:
        command_line("gazebo", PHYSICS)
    assert "apt-get install g++ pkg-config nlohmann-json3-dev libignition-transport-dev" in error_info.value.remedy
