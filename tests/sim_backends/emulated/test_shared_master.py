"""Robots with one ROS master on the relay: a real roscore, and ROS traffic between robots crosses the medium."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader

from fieldkit.config import schema
from fieldkit.config.site import Site
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Fault, FaultKind, Placement, Protocol, Role, Scenario, Topology, Verdict
from fieldkit.core.units import parse_distance
from fieldkit.remote.command import with_environment
from fieldkit.remote.shell import Shell
from fieldkit.ros.steps import ros_master
from fieldkit.steps.scene import CommandResult, Need, Scene
from sim_backends.emulated import requirements, testbed
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.provisioning import KeyPair, robot_spec
from sim_backends.emulated.robot import services
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.sshd import wait_until

SETUP = "/opt/ros/noetic/setup.bash"
LONG_S = 60.0


def backend(extra_keys: str = "") -> EmulatedBackend:
    text = DEFAULT_SITE.read_text(encoding="utf-8")
    document = schema.parse(f"{text}\nros_master: relay\n{extra_keys}", source="fieldkit.yaml")
    return EmulatedBackend(schema.validate(document, Site), document)


@pytest.fixture(scope="module")
def emulation() -> Iterator[EmulatedTestbed]:
    with testbed.bring_up(
        backend().cast(Topology.MASTER),
        options=EmulatedOptions(radio=RadioOptions(fading=False)),
        world=load_world("lawn"),
        ros=RosChoice.DEBIAN,
        seed=1,
    ) as robots:
        robots.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("5m")))
        yield robots


def wait(condition: Callable[[], bool]) -> None:
    wait_until(condition, Deadline.after(LONG_S))


def output_of(shell: Shell, *argv: str) -> str:
    return shell.run(argv, deadline=Deadline.after(LONG_S)).stdout.decode()


def run_in_ros(emulation: EmulatedTestbed, role: Role, *argv: str) -> str:
    return output_of(emulation.shells[role], *with_environment(argv, setup=emulation.robots[role].spec.setup))


def process_names(shell: Shell) -> set[str]:
    return set(
        output_of(shell, "sh", "-c", "cat /proc/[0-9]*/comm 2>/dev/null || true").split()
    )  # some exit meanwhile


def run_probe(shell: Shell, need: Need) -> CommandResult:
    result = shell.run(need.argv, deadline=Deadline.after(LONG_S), check=False)
    return CommandResult((result.stdout + result.stderr).decode().strip(), result.exit_code)


@pytest.mark.emulated
def test_the_relay_runs_roscore_and_the_others_no_master(emulation: EmulatedTestbed) -> None:
    masters = {"roscore", "rosmaster", "rosout"}
    wait(lambda: masters <= process_names(emulation.shells[Role.RELAY]))
    for role in (Role.SENDER, Role.RECEIVER):
        assert not masters & process_names(emulation.shells[role])


@pytest.mark.emulated
def test_every_robot_lists_all_topics_with_one_publisher_each(emulation: EmulatedTestbed) -> None:
    for role in emulation.shells:
        wait_for_topics(emulation, role, {"/scan", "/odom", "/imu", "/battery_state", "/pidrone/imu", "/rosout"})
    info = run_in_ros(emulation, Role.RECEIVER, "rostopic", "info", "/scan")
    publishers = info.partition("Publishers:")[2].partition("Subscribers:")[0].split()
    assert publishers[:2] == ["*", "/sensors_turtlebot_1"], "the other TurtleBot's laser has the same name"
    assert len([publisher for publisher in publishers if publisher == "*"]) == 1
    assert "(http://10.42.0.1:" in info


@pytest.mark.emulated
def test_subscriptions_to_another_robot_cross_the_medium(emulation: EmulatedTestbed, tmp_path: Path) -> None:
    receiver = emulation.shells[Role.RECEIVER]
    wait_for_topics(emulation, Role.RECEIVER, {"/scan"})
    before = emulation.medium.stats().ports["turtlebot-1"].sent_packets
    run_in_ros(emulation, Role.RECEIVER, "rosbag", "record", "-l", "5", "-O", "other_robot", "/scan")
    bag = tmp_path / "other_robot.bag"
    receiver.fetch(("cat", "other_robot.bag"), bag, deadline=Deadline.after(LONG_S), limit_bytes=1 << 20)
    with Reader(bag) as reader:
        count = reader.message_count
        assert {getattr(connection.ext, "callerid", None) for connection in reader.connections} == {
            "/sensors_turtlebot_1"
        }
    assert count == 5
    # 2.9 kB in segments of 1,448 bytes.
    assert emulation.medium.stats().ports["turtlebot-1"].sent_packets - before >= 3 * count


@pytest.mark.emulated
def test_the_preflight_probe_detects_a_master_and_its_absence(emulation: EmulatedTestbed) -> None:
    cast = backend().cast(Topology.MASTER)
    scene = Scene(Protocol.TCP, cast, "f")
    (need,) = ros_master.needs(scene, Role.SENDER, program="rosbag")
    answer = run_probe(emulation.shells[Role.SENDER], need)
    assert ros_master.judge(cast[Role.RELAY], answer)[0] is Verdict.OK, answer
    cast_with_another_master = {
        role: robot.model_copy(update={"ros_master": "10.42.0.2"}) for role, robot in cast.items()
    }
    (need,) = ros_master.needs(Scene(Protocol.TCP, cast_with_another_master, "f"), Role.SENDER, program="rosbag")
    answer = run_probe(emulation.shells[Role.SENDER], need)
    assert ros_master.judge(cast[Role.RECEIVER], answer)[0] is Verdict.FAIL
    assert "Connection refused" in answer.text


@pytest.mark.emulated
def test_a_restarted_master_has_no_topics_until_nodes_register(emulation: EmulatedTestbed) -> None:
    relay, sender = emulation.shells[Role.RELAY], emulation.shells[Role.SENDER]
    wait(lambda: "rosmaster" in process_names(relay))
    emulation.inject(Fault(FaultKind.KILL, Role.RELAY, process="rosmaster"))
    wait(lambda: "/scan" not in topics_of(sender))
    wait(lambda: {"rosmaster", "rosout"} <= process_names(relay))
    assert "/scan" not in topics_of(sender)
    emulation.inject(Fault(FaultKind.KILL, Role.SENDER, process="ros_relay"))
    wait(lambda: "/scan" in topics_of(sender))


def wait_for_topics(emulation: EmulatedTestbed, role: Role, topics: set[str]) -> None:
    """Wait until the nodes, which start one after another, have registered their topics."""
    wait(lambda: topics <= set(run_in_ros(emulation, role, "rostopic", "list").split()))


def topics_of(shell: Shell) -> list[str]:
    argv = with_environment(["rostopic", "list"], setup=[SETUP])
    return shell.run(argv, deadline=Deadline.after(LONG_S), check=False).stdout.decode().split()


def test_a_robot_without_a_shared_master_has_a_separate_one() -> None:
    cast = backend().cast(Topology.MASTERLESS)
    keys = KeyPair.make(), KeyPair.make()
    spec = robot_spec(cast, Role.SENDER, ros=RosChoice.DEBIAN, login=keys[0], host_key=keys[1])
    assert spec.runs_master
    assert not spec.shares_master
    assert spec.ros1_environment == {"ROS_MASTER_URI": "http://127.0.0.1:11311", "ROS_IP": "127.0.0.1"}
    assert [service.name for service in services.services(spec)] == [
        "sshd",
        "sensors",
        "base",
        "rosmaster",
        "ros_relay",
    ]
    assert spec.registered_topics == ("/scan", "/odom", "/tf", "/imu", "/battery_state")


def test_the_first_of_equal_robots_publishes_and_the_relay_runs_roscore() -> None:
    cast = backend().cast(Topology.MASTER)
    keys = KeyPair.make(), KeyPair.make()
    specs = {role: robot_spec(cast, role, ros=RosChoice.DEBIAN, login=keys[0], host_key=keys[1]) for role in cast}
    assert {role: bool(spec.registered_topics) for role, spec in specs.items()} == {
        Role.SENDER: True,
        Role.RECEIVER: False,
        Role.RELAY: True,
    }
    assert [role for role, spec in specs.items() if spec.runs_master] == [Role.RELAY]
    assert {services.ros_node(spec) for spec in specs.values()} == {
        "sensors_turtlebot_1",
        "sensors_turtlebot_2",
        "sensors_duckiedrone_1",
    }


def test_the_built_in_ros_has_no_shared_master(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigurationError, match="which for emulated robots needs Debian's ROS") as error_info:
        requirements.check_shared_master(RosChoice.BUILTIN)
    assert "python3-rosmaster" in error_info.value.remedy
    requirements.check_shared_master(RosChoice.DEBIAN)
    monkeypatch.setattr(requirements, "_MASTER_FILES", {"/no/roscore": "python3-roslaunch"})
    with pytest.raises(ConfigurationError) as error_info:
        requirements.check_shared_master(RosChoice.DEBIAN)
    assert error_info.value.remedy.startswith("apt-get install --no-install-recommends python3-roslaunch, and")
