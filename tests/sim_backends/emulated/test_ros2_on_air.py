"""Emulated robots with ROS 2: what a real ROS 2, and other nodes of DDS and Zenoh, hear of them over the medium."""

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import pairwise, takewhile
from typing import Any, Final

import numpy as np
import pytest

from fieldkit.backends.protocols import Cast
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile, load_profile
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Fault, FaultKind, Leg, Move, Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.ros import topics
from fieldkit.ros.qos import PROFILES
from fieldkit.ros.types import shipped
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.options import EmulatedOptions, RosChoice, load_options
from sim_backends.emulated.provisioning import KeyPair, robot_spec
from sim_backends.emulated.robot import services
from sim_backends.emulated.ros import offered_qos
from sim_backends.emulated.ros.messages import GRAVITY_M_S2, ODOMETRY_VARIANCES
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.world.world import load_world
from tests.helpers.casts import ros_of
from tests.helpers.paths import ROOT

ROS2: Final = ROOT / ".ros2" / "bin" / "python"
LISTENER: Final = ROOT / "tests" / "sim_backends" / "emulated" / "ros2_listener.py"
WIRE_END: Final = ROOT / "tests" / "ros" / "wire_end.py"
HEARD: Final = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/odom": "nav_msgs/msg/Odometry",
    "/imu": "sensor_msgs/msg/Imu",
    "/battery_state": "sensor_msgs/msg/BatteryState",
}
COUNT: Final = 3
DRIVEN_M: Final = 0.1
LONG_S: Final = 120
PLACED: Final = Placement(Scenario.LOS, Topology.MASTER, parse_distance("5m"))
ROUTER: Final = "{discovery: router, router: duckiedrone-1}"
NODES: Final = {Role.SENDER: "sensors_turtlebot_1", Role.RECEIVER: "sensors_turtlebot_2"}


def speaking(rmw: str, distribution: str = "jazzy", **environment: str) -> RobotProfile:
    profile = load_profile("turtlebot3_burger")
    command = ros_of(profile).variants["ros2"].model_copy(update={"distribution": distribution, "rmw": rmw})
    told = {"variant": "ros2", "variants": {"ros2": command}, "environment": environment}
    return profile.model_copy(update={"ros": ros_of(profile).model_copy(update=told)})


def cast(**rmws: str) -> Cast:
    """Return the paper's robots, of which some speak ROS 2, by their role."""
    master = EmulatedBackend(None, None).cast(Topology.MASTER)
    return {
        role: robot.model_copy(update={"profile": speaking(rmws[role])}) if role in rmws else robot
        for role, robot in master.items()
    }


def options(ros2: str, ros: str = "auto") -> EmulatedOptions:
    return load_options(schema.parse(f"emulated: {{radio: {{fading: false}}, ros: {ros}, ros2: {ros2}}}", source="x"))


@contextmanager
def lab(robots: Cast, ros2: str) -> Iterator[EmulatedTestbed]:
    chosen = options(ros2)
    with testbed.bring_up(robots, options=chosen, world=load_world("lawn"), ros=RosChoice.BUILTIN, seed=1) as up:
        up.place(PLACED)
        yield up


@pytest.fixture(scope="module")
def multicast() -> Iterator[EmulatedTestbed]:
    with lab(cast(sender="cyclonedds", receiver="zenoh"), "{}") as up:
        yield up


def inside(up: EmulatedTestbed, *argv: str) -> tuple[str, ...]:
    """Return a command in the network of the drone, which has no ROS 2 of its own."""
    return ("timeout", "-k", "10", str(LONG_S), "nsenter", "-t", str(up.robots[Role.RELAY].pid), "-n", *argv)


@contextmanager
def listening(up: EmulatedTestbed, over: str, topic: str, kind: str, **network: object) -> Iterator[Iterator[Any]]:
    """Yield the messages, of rosbags' types, that a node of DDS or Zenoh on the drone hears."""
    told = {"address": up.robots[Role.RELAY].spec.ip, "node": "ears", **network}
    quality = offered_qos.LATCHED if topic == "/tf_static" else PROFILES["sensor_data"]
    described = topics.describe(shipped(), topic, kind, quality, domain=0, node="ears")
    command = (sys.executable, str(WIRE_END), "hear", over, json.dumps(told), json.dumps(described))
    with subprocess.Popen(inside(up, *command), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as ears:
        assert ears.stdout is not None
        try:
            yield (shipped().ros2.deserialize_cdr(bytes.fromhex(line), described["type"]) for line in ears.stdout)
        finally:
            ears.terminate()
            ears.communicate()


def hears(up: EmulatedTestbed, over: str, topic: str, kind: str, **network: object) -> Any:  # noqa: ANN401 (of rosbags)
    """Return the first message of `listening`."""
    with listening(up, over, topic, kind, **network) as heard:
        return next(heard)


def stamp_s(message: Any) -> float:  # noqa: ANN401 (of rosbags)
    return float(message.header.stamp.sec + message.header.stamp.nanosec / 1e9)


@pytest.fixture(scope="module")
def told(multicast: EmulatedTestbed, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    """What a node of a real ROS 2 on the drone says of the sender."""
    home = tmp_path_factory.mktemp("ros")
    words = (str(COUNT), *(f"{topic}={kind}" for topic, kind in HEARD.items()))
    command = inside(multicast, "env", f"ROS_HOME={home}", str(ROS2), str(LISTENER), *words)
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    found: Mapping[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.emulated
def test_a_real_ros_2_lists_the_topics_with_their_types_and_hashes(told: Mapping[str, Any]) -> None:
    wanted = {**HEARD, "/tf": "tf2_msgs/msg/TFMessage", "/tf_static": "tf2_msgs/msg/TFMessage"}
    assert {topic: told["types"].get(topic) for topic in wanted} == {topic: [kind] for topic, kind in wanted.items()}
    assert told["latched"] == ["TRANSIENT_LOCAL"]
    assert told["hashes"] == {topic: [shipped().get(kind).rihs01] for topic, kind in wanted.items()}


@pytest.mark.emulated
def test_a_real_ros_2_lists_the_node_and_what_is_its_own(told: Mapping[str, Any]) -> None:
    assert NODES[Role.SENDER] in told["nodes"]
    topics_of_node = {topic for topic, _ in told["of_node"][NODES[Role.SENDER]]}
    assert topics_of_node == {*HEARD, "/tf", "/tf_static", "/rosout"}


@pytest.mark.emulated
def test_a_real_ros_2_reads_the_node_s_log(told: Mapping[str, Any]) -> None:
    of_robot = NODES[Role.SENDER]
    lines = [line for line in told["logged"] if line["name"] == of_robot]
    assert {f"{topic} has a subscriber" for topic in HEARD} <= {line["msg"] for line in lines}
    assert {line["level"] for line in lines} == {20}, "rcl_interfaces/msg/Log.INFO"
    assert all(0 <= time.time() - line["stamp"]["sec"] < LONG_S for line in lines)
    # Of the robot, and of the listener, which is rclpy's own.
    assert told["rosout"] == [["TRANSIENT_LOCAL", 10_000_000_000]] * 2


@pytest.mark.emulated
def test_the_page_names_all_that_the_node_lacks(told: Mapping[str, Any]) -> None:
    """Of what the node of rclpy that listens has by itself; a name of its own begins with that of the node."""
    of_robot = NODES[Role.SENDER]
    services_of_rclpy = {service.rpartition("/")[2] for service in told["services_of_node"]["listener"]}
    assert {"list_parameters", "get_type_description"} <= services_of_rclpy
    assert told["services_of_node"][of_robot] == []
    topics_of_robot = {topic for topic, _ in told["of_node"][of_robot]}
    lacking = services_of_rclpy | (set(told["own_topics"]) - topics_of_robot - {"/cmd_vel"})
    page = (ROOT / "docs" / "add-a-robot.md").read_text(encoding="utf-8")
    section = page.partition("### What its node lacks")[2].partition("\n## ")[0]
    assert [name for name in sorted(lacking) if f"`{name}`" not in section] == []
    assert "`/rosout`" in section


@pytest.mark.emulated
def test_a_real_ros_2_hears_right_values_across_the_medium(
    multicast: EmulatedTestbed, told: Mapping[str, Any]
) -> None:
    heard = told["heard"]
    for topic in HEARD:
        stamps_s = [one["header"]["stamp"]["sec"] + one["header"]["stamp"]["nanosec"] / 1e9 for one in heard[topic]]
        assert len(stamps_s) == COUNT
        assert all(0 <= time.time() - stamp_s < LONG_S for stamp_s in stamps_s), topic
    scan = heard["/scan"][0]
    assert scan["header"]["frame_id"] == "base_scan"
    assert scan["ranges"] == [math.inf] * 360, "the lawn has nothing within 3.5 m of the line"
    odom = heard["/odom"][0]
    assert (odom["header"]["frame_id"], odom["child_frame_id"]) == ("odom", "base_footprint")
    assert odom["pose"]["covariance"][:: 6 + 1] == list(ODOMETRY_VARIANCES)
    assert heard["/imu"][0]["linear_acceleration"]["z"] == pytest.approx(GRAVITY_M_S2, abs=0.2)
    battery = heard["/battery_state"][0]
    assert battery["percentage"] == pytest.approx(0.8)
    assert math.isnan(battery["current"])
    # A scan is 2.9 kB, in two fragments.
    assert multicast.medium.stats().ports["turtlebot-1"].read >= 2 * COUNT


@pytest.mark.emulated
def test_a_real_ros_2_drives_the_robot_by_its_velocity_topic(
    multicast: EmulatedTestbed, told: Mapping[str, Any]
) -> None:
    """In odometry, and in the world, as the medium is told."""
    assert told["types"]["/cmd_vel"] == ["geometry_msgs/msg/Twist"]
    assert told["driven_m"] >= DRIVEN_M
    places_m = [one.position_m for one in multicast.oracle.track(0) if one.role is Role.SENDER and one.position_m]
    assert max(math.dist(places_m[0], place_m) for place_m in places_m) >= DRIVEN_M / 2


@pytest.mark.emulated
def test_odometry_heard_by_another_robot_adds_up_to_the_way_through_the_world(multicast: EmulatedTestbed) -> None:
    move = Move(Role.SENDER, (Leg(away_m=1.0), Leg(left_m=0.5)), speed_m_s=0.5)
    multicast.place(PLACED)  # it may have driven off by itself
    with listening(multicast, "dds", "/odom", "nav_msgs/Odometry") as heard:
        first = next(heard)
        begin, begun_ns = first.pose.pose.position, time.time_ns()
        with multicast.moving(move):
            told = [first, *takewhile(lambda one: one.pose.pose.position.y < begin.y + 0.499, heard)]
            whereabouts = [one for one in multicast.oracle.track(begun_ns) if one.role is Role.SENDER]
    x_m = y_m = 0.0
    for before, after in pairwise(told):
        facing_rad = 2 * math.atan2(before.pose.pose.orientation.z, before.pose.pose.orientation.w)
        gone_m = before.twist.twist.linear.x * (stamp_s(after) - stamp_s(before))
        x_m, y_m = x_m + gone_m * math.cos(facing_rad), y_m + gone_m * math.sin(facing_rad)
    end = told[-1].pose.pose.position
    assert (x_m, y_m) == pytest.approx((end.x - begin.x, end.y - begin.y), abs=0.1)
    assert (x_m, y_m) == pytest.approx((1.0, 0.5), abs=0.1)
    begin_m, end_m = (whereabouts[number].position_m for number in (0, -1))
    assert begin_m is not None
    assert end_m is not None
    # The medium is told every 0.1 m.
    assert math.dist(begin_m[:2], end_m[:2]) == pytest.approx(math.hypot(x_m, y_m), abs=0.2)


@pytest.mark.emulated
def test_sensors_that_were_killed_are_heard_again(multicast: EmulatedTestbed) -> None:
    with listening(multicast, "dds", "/battery_state", "sensor_msgs/BatteryState") as heard:
        last = next(heard)
        multicast.inject(Fault(FaultKind.KILL, Role.SENDER, process="sensors"))
        began_s = time.time()
        assert any(stamp_s(one) > began_s for one in heard), f"none after {last}"
    # The relay itself goes on: it has left a topic whose publisher was gone.
    assert hears(multicast, "dds", "/odom", "nav_msgs/Odometry").child_frame_id == "base_footprint"


@pytest.mark.emulated
def test_zenoh_scouts_across_the_medium(multicast: EmulatedTestbed) -> None:
    message = hears(multicast, "zenoh", "/tf", "tf2_msgs/TFMessage")
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_footprint")


@pytest.mark.emulated
def test_unicast_peers_need_no_multicast() -> None:
    with lab(cast(sender="cyclonedds", receiver="zenoh"), "{discovery: peers}") as up:
        for role, over in ((Role.SENDER, "dds"), (Role.RECEIVER, "zenoh")):
            peers = (up.robots[role].spec.ip,)
            odom = hears(up, over, "/odom", "nav_msgs/Odometry", discovery="peers", peers=peers)
            assert odom.child_frame_id == "base_footprint"


@pytest.mark.emulated
def test_a_router_on_the_relay_brings_zenoh_together() -> None:
    with lab(cast(sender="zenoh"), ROUTER) as up:
        relay = up.robots[Role.RELAY].spec.ip
        scan = hears(up, "zenoh", "/scan", "sensor_msgs/LaserScan", discovery="router", server=relay)
        assert np.isinf(scan.ranges).all()
        assert len(scan.ranges) == 360


@pytest.mark.emulated
@pytest.mark.parametrize("over", ["dds", "zenoh"])
def test_whoever_comes_finds_the_way_from_every_sensor_to_the_world(multicast: EmulatedTestbed, over: str) -> None:
    """What tf2 looks up: from the frame of a message, up to where the robot was switched on."""
    lies_in = {
        one.child_frame_id: one.header.frame_id
        for topic in ("/tf_static", "/tf")
        for one in hears(multicast, over, topic, "tf2_msgs/TFMessage").transforms
    }
    for topic in ros_of(load_profile("turtlebot3_burger")).topics:
        frame = topic.frame
        while frame in lies_in:
            frame = lies_in[frame]
        assert frame in {"odom", ""}, topic.name


def specs(robots: Cast, ros2: str, ros: str = "auto") -> Mapping[Role, Any]:
    made = partial(robot_spec, robots, ros=RosChoice.BUILTIN, login=KeyPair.make(), host_key=KeyPair.make())
    return {role: made(role, options=options(ros2, ros)) for role in robots}


def test_each_robot_is_told_how_it_takes_part() -> None:
    found = specs(cast(sender="cyclonedds", receiver="zenoh"), "{discovery: peers}")
    assert found[Role.SENDER].ros2.peers == ("10.42.0.2", "10.42.0.3")
    assert (found[Role.SENDER].ros2.over, found[Role.RECEIVER].ros2.over) == ("dds", "zenoh")
    assert found[Role.RELAY].ros2 is None
    found = specs(cast(sender="zenoh"), ROUTER)
    assert (found[Role.SENDER].ros2.router, found[Role.SENDER].ros2.peers) == ("10.42.0.3", ())
    assert [role for role in found if found[role].routes_zenoh] == [Role.RELAY]
    assert "zenoh_router" in [one.name for one in services.services(found[Role.RELAY])]


def test_the_built_in_ros_stays_off_the_air() -> None:
    assert specs(cast(sender="cyclonedds"), "{}", ros="builtin")[Role.SENDER].ros2 is None


def test_a_router_that_takes_no_part_is_refused() -> None:
    robots = {role: one for role, one in cast(sender="zenoh").items() if role is not Role.RELAY}
    with pytest.raises(
        ConfigurationError, match=r"emulated\.ros2\.router is duckiedrone-1, which does not take part"
    ):
        specs(robots, ROUTER)


@pytest.mark.parametrize(
    ("ros2", "said"),
    [
        ("{discovery: router}", "go together"),
        ("{router: duckiedrone-1}", "go together"),
        ("{discovery: router, router: drone}", "emulated.ros2.router names 'drone', which the lab does not have"),
        ("{discovery: magic}", "emulated.ros2.discovery"),
    ],
)
def test_wrong_options_are_told(ros2: str, said: str) -> None:
    text = f"{DEFAULT_SITE.read_text(encoding='utf-8')}\nemulated: {{ros2: {ros2}}}\n"
    document = schema.parse(text, source="fieldkit.yaml")
    with pytest.raises(ConfigurationError, match=said):
        EmulatedBackend(schema.validate(document, Site), document)


@pytest.mark.parametrize(
    ("ros2", "profile", "said"),
    [
        (ROUTER, speaking("cyclonedds"), "uses DDS, which has no router"),
        ("{}", speaking("zenoh", ROS_DOMAIN_ID="150"), "the ports of ROS_DOMAIN_ID 150 of the profile"),
    ],
)
def test_what_a_profile_cannot_have_is_told(
    ros2: str, profile: RobotProfile, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = f"{DEFAULT_SITE.read_text(encoding='utf-8')}\nemulated: {{ros2: {ros2}}}\n"
    document = schema.parse(text, source="fieldkit.yaml")
    backend = EmulatedBackend(schema.validate(document, Site), document)
    monkeypatch.setattr("fieldkit.backends.registry.load_profile", lambda _: profile)
    with pytest.raises(ConfigurationError, match=said):
        backend.cast(Topology.MASTER)
