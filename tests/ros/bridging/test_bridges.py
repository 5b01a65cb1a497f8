"""Bridges in profiles: the jobs on robots, and a laser scan that is bridged from ROS 1 to DDS."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from fieldkit.backends.protocols import Cast
from fieldkit.config import schema
from fieldkit.config.profiles import RobotBridge, RobotProfile, load_profile
from fieldkit.config.site import Site
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.events import Event, Note
from fieldkit.core.model import BRIDGE_IS_UP, Placement, Role, Scenario, Topology
from fieldkit.core.prompts import UNATTENDED
from fieldkit.core.units import parse_distance
from fieldkit.lab.robots import LabRobot
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.ros.bridging import session_bridges
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from fieldkit.trial import session_jobs
from fieldkit.trial.check import software
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.running_robots import running_robots
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.casts import los_plan, ros_of
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until

WIRE_END: Final = ROOT / "tests" / "ros" / "bridging" / "wire_end.py"
LONG_S: Final = 60.0
SCAN: Final = "/scan:sensor_msgs/LaserScan:sensor_data"
TWIST: Final = "/cmd_vel:geometry_msgs/Twist"
BRIDGE: Final = RobotBridge(to="dds", topics=(SCAN,), back=(TWIST,), domain=7)
OPTIONS: Final = EmulatedOptions(radio=RadioOptions(fading=False))


def profile_with_bridge(bridge: RobotBridge = BRIDGE) -> RobotProfile:
    profile = load_profile("turtlebot3_burger")
    return profile.model_copy(update={"ros": ros_of(profile).model_copy(update={"bridge": bridge})})


def cast(bridge: RobotBridge = BRIDGE) -> Cast:
    """Return a cast of a TurtleBot with a bridge and a drone."""
    robots = EmulatedBackend(None, None).cast(Topology.MASTERLESS)
    return {**robots, Role.SENDER: robots[Role.SENDER].model_copy(update={"profile": profile_with_bridge(bridge)})}


@pytest.fixture(scope="module")
def emulation() -> Iterator[EmulatedTestbed]:
    with testbed.bring_up(cast(), options=OPTIONS, world=load_world("lawn"), ros=RosChoice.DEBIAN, seed=1) as robots:
        robots.place(Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("5m")))
        yield robots


def bridge_jobs(robots: Cast) -> dict[Role, Job]:
    return {planned.role: planned.job for planned in session_bridges.planned(robots, "s1")}


def soon() -> Deadline:
    return Deadline.after(LONG_S)


def receive_first_scan(pid: int, address: str) -> bytes:
    """Return the first scan that a DDS node receives in a robot's network."""
    network = json.dumps({"address": address, "node": "ears", "domain": BRIDGE.domain})
    kind, profile = "sensor_msgs/LaserScan", PROFILES["sensor_data"]
    topic = json.dumps(topics.describe(standard_types(), "/scan", kind, profile, domain=BRIDGE.domain, node="ears"))
    inside = ("timeout", "-k", "10", str(LONG_S), "nsenter", "-t", str(pid), "-n")
    command = (*inside, sys.executable, str(WIRE_END), "hear", "dds", network, topic)
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as subscriber:
        assert subscriber.stdout is not None
        line = subscriber.stdout.readline()
        subscriber.terminate()
        _, errors = subscriber.communicate()
    assert line, errors
    return bytes.fromhex(line)


@pytest.mark.emulated
def test_dds_nodes_receive_ros_1_messages_during_the_session(emulation: EmulatedTestbed) -> None:
    events: list[Event] = []
    shell, drone = emulation.shells[Role.SENDER], emulation.robots[Role.RECEIVER]
    with session_jobs.running(cast(), emulation.shells, "s1", sink=events.append):
        (list_running,) = jobs.list_running(shell, soon())
        assert f"/{session_bridges.folder_of('s1')}/" in list_running
        scan: Any = standard_types().ros2.deserialize_cdr(
            receive_first_scan(drone.pid, drone.spec.ip), "sensor_msgs/msg/LaserScan"
        )
    assert (scan.header.frame_id, len(scan.ranges)) == ("base_scan", 360)
    assert jobs.list_running(shell, soon()) == ()
    assert not [event for event in events if isinstance(event, Note)], "the bridge exited successfully"


@pytest.mark.emulated
def test_a_bridge_that_does_not_start_is_reported_with_its_output(emulation: EmulatedTestbed) -> None:
    invalid_cast = cast(BRIDGE.model_copy(update={"topics": ("/scan:sensor_msgs/LasrScan",)}))
    with (
        pytest.raises(RobotError, match="LaserScan") as caught,
        session_jobs.running(invalid_cast, emulation.shells, "s2", sink=lambda _: None),
    ):
        raise AssertionError("the bridge must not start")
    assert "its bridge does not start" in str(caught.value)
    assert jobs.list_running(emulation.shells[Role.SENDER], soon()) == ()


@pytest.mark.emulated
def test_a_bridge_that_exits_early_is_reported(emulation: EmulatedTestbed) -> None:
    events: list[Event] = []
    short = f"#!/bin/sh\necho {BRIDGE_IS_UP}\nexit 3\n"
    emulation.shells[Role.SENDER].run(
        ("sh", "-c", "cat >short && chmod +x short"), stdin=short.encode(), deadline=soon()
    )
    exiting_cast = cast(BRIDGE.model_copy(update={"program": "/root/short"}))
    with session_jobs.running(exiting_cast, emulation.shells, "s3", sink=events.append):
        wait_until(lambda: not jobs.list_running(emulation.shells[Role.SENDER], soon()), soon())
    (note,) = [event for event in events if isinstance(event, Note)]
    assert note.text == "the bridge on turtlebot-1 exited early, with exit code 3"


@pytest.mark.emulated
def test_in_an_interactive_lab_the_bridge_is_a_service_of_the_robot() -> None:
    members = {
        name: LabRobot(name, profile, address, ())
        for name, profile, address in (
            ("turtlebot-1", profile_with_bridge(), "10.42.0.1"),
            ("duckiedrone-1", load_profile("duckiedrone"), "10.42.0.2"),
        )
    }
    with running_robots(members, options=OPTIONS, world=load_world("lawn"), ros=RosChoice.DEBIAN, seed=1) as lab:
        lab.medium.place({"turtlebot-1": (0.0, 0.0, 0.2), "duckiedrone-1": (5.0, 0.0, 0.2)})
        drone = lab.robots["duckiedrone-1"]
        assert receive_first_scan(drone.pid, drone.spec.ip)


def test_the_job_of_a_robot_has_the_command_line_of_its_bridge() -> None:
    jobs_by_role = bridge_jobs(cast())
    assert jobs_by_role.keys() == {Role.SENDER}
    assert jobs_by_role[Role.SENDER].argv == (
        *("bash", "-c", '. /opt/ros/noetic/setup.bash && exec "$@"', "bash"),
        *("fieldkit", "bridge", "--from", "ros1", "--to", "dds", "--address", "10.42.0.1", "--domain", "7"),
        *("--patience", "5", "--back", TWIST, SCAN),
    )
    routed_bridge = BRIDGE.model_copy(update={"to": "zenoh", "router": "10.42.0.3"})
    assert routed_bridge.command("10.42.0.1", "10.42.0.9", 5)[-7:] == (
        *("--master", "10.42.0.9", "--router", "10.42.0.3"),
        *("--back", TWIST, SCAN),
    )


def test_only_the_first_of_robots_with_a_common_master_has_a_bridge() -> None:
    master = EmulatedBackend(None, None).cast(Topology.MASTER)
    bridge_changes = {"profile": profile_with_bridge()}
    robots = {
        role: robot.model_copy(update=bridge_changes if role is not Role.RELAY else {})
        for role, robot in master.items()
    }
    assert bridge_jobs(robots).keys() == {Role.SENDER, Role.RECEIVER}, "each robot has a separate master"
    shared = {role: robot.model_copy(update={"ros_master": "10.42.0.3"}) for role, robot in robots.items()}
    jobs_by_role = bridge_jobs(shared)
    assert jobs_by_role.keys() == {Role.SENDER}
    assert "10.42.0.3" in jobs_by_role[Role.SENDER].argv


@pytest.mark.parametrize(
    ("text", "output_text"),
    [
        ("{to: dds}", "it carries no topics"),
        ("{to: ros1, topics: ['/scan:sensor_msgs/LaserScan']}", "bridge.to"),
        ("{to: dds, topics: [/scan]}", "bridge.topics.0"),
        ("{to: dds, topics: ['/scan:sensor_msgs/LaserScan'], router: 10.42.0.3}", "only Zenoh has a router"),
        ("{to: zenoh, topics: ['/scan:sensor_msgs/LaserScan'], router: 'a b'}", "bridge.router"),
        ("{to: dds, topics: ['/scan:sensor_msgs/LaserScan'], domain: 102}", "bridge.domain"),
        ("{to: dds, topic: ['/scan:sensor_msgs/LaserScan']}", "topics"),
    ],
)
def test_a_wrong_profile_is_reported_with_its_location(text: str, output_text: str, tmp_path: Path) -> None:
    profile = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    file = tmp_path / "own.yaml"
    file.write_text(profile.replace("ros:\n  variant: ros1\n", f"ros:\n  variant: ros1\n  bridge: {text}\n"))
    with pytest.raises(ConfigurationError, match=output_text) as caught:
        schema.load(file, RobotProfile)
    assert "own.yaml:" in str(caught.value)


def test_a_robot_with_ros_2_needs_no_bridge(tmp_path: Path) -> None:
    profile = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    file = tmp_path / "own.yaml"
    configuration = f"ros:\n  variant: ros2\n  bridge: {{to: dds, topics: ['{SCAN}']}}\n"
    file.write_text(profile.replace("ros:\n  variant: ros1\n", configuration))
    with pytest.raises(ConfigurationError, match="needs no bridge"):
        schema.load(file, RobotProfile)


def test_an_emulated_lab_without_debian_s_ros_rejects_a_bridge(monkeypatch: pytest.MonkeyPatch) -> None:
    text = f"{DEFAULT_SITE.read_text(encoding='utf-8')}\nemulated: {{ros: builtin}}\n"
    document = schema.parse(text, source="fieldkit.yaml")
    backend = EmulatedBackend(schema.validate(document, Site), document)
    monkeypatch.setattr("sim_backends.emulated.requirements.check", lambda _, **__: None)
    with (
        pytest.raises(ConfigurationError, match="has a bridge, which needs Debian's ROS"),
        backend.open(cast(), seed=1, sink=lambda _: None, operator=UNATTENDED),
    ):
        raise AssertionError("the lab must not open")


def test_the_preflight_check_includes_the_program_of_the_bridge() -> None:
    plan = los_plan()
    robot = plan.cast[Role.SENDER].model_copy(update={"profile": profile_with_bridge()})
    plan = plan.model_copy(update={"cast": {**plan.cast, Role.SENDER: robot}})
    assert "program fieldkit" in software.commands(plan, Role.SENDER)
    assert "program fieldkit" not in software.commands(plan, Role.RECEIVER)
