"""Emulated robots with ROS 2, received over the medium by a real ROS 2 and by other nodes of DDS and Zenoh."""

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
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice, load_options
from sim_backends.emulated.provisioning import KeyPair, robot_spec
from sim_backends.emulated.robot import services
from sim_backends.emulated.ros import offered_qos
from sim_backends.emulated.ros.messages import ODOMETRY_VARIANCES
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.world.motion import GRAVITY_M_S2
from sim_backends.world.world import load_world
from tests.helpers.casts import ros_of
from tests.helpers.paths import ROOT

ROS2: Final = ROOT / ".ros2" / "bin" / "python"
LISTENER: Final = ROOT / "tests" / "sim_backends" / "emulated" / "ros2_listener.py"
WIRE_END: Final = ROOT / "tests" / "ros" / "bridging" / "wire_end.py"
RECEIVED: Final = {
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


def profile_with(rmw: str, distribution: str = "jazzy", **environment: str) -> RobotProfile:
    profile = load_profile("turtlebot3_burger")
    command = ros_of(profile).variants["ros2"].model_copy(update={"distribution": distribution, "rmw": rmw})
    ros = {"variant": "ros2", "variants": {"ros2": command}, "environment": environment}
    return profile.model_copy(update={"ros": ros_of(profile).model_copy(update=ros)})


def cast(**rmws: str) -> Cast:
    """Return the paper's robots by their role; those with an RMW use ROS 2."""
    master = EmulatedBackend(None, None).cast(Topology.MASTER)
    return {
        role: robot.model_copy(update={"profile": profile_with(rmws[role])}) if role in rmws else robot
        for role, robot in master.items()
    }


def options(ros2: str, ros: str = "auto") -> EmulatedOptions:
    return load_options(schema.parse(f"emulated: {{radio: {{fading: false}}, ros: {ros}, ros2: {ros2}}}", source="x"))


@contextmanager
def lab(robots: Cast, ros2: str) -> Iterator[EmulatedTestbed]:
    lab_options = options(ros2)
    with testbed.bring_up(
        robots, options=lab_options, world=load_world("lawn"), ros=RosChoice.BUILTIN, seed=1
    ) as emulation:
        emulation.place(PLACED)
        yield emulation


@pytest.fixture(scope="module")
def multicast() -> Iterator[EmulatedTestbed]:
    with lab(cast(sender="cyclonedds", receiver="zenoh"), "{}") as emulation:
        yield emulation


def drone_command(emulation: EmulatedTestbed, *argv: str) -> tuple[str, ...]:
    """Return a command in the network namespace of the drone, which has no ROS 2."""
    return (
        "timeout",
        "-k",
        "10",
        str(LONG_S),
        "nsenter",
        "-t",
        str(emulation.robots[Role.RELAY].pid),
        "-n",
        *argv,
    )


@contextmanager
def subscribed(
    emulation: EmulatedTestbed, middleware_name: str, topic: str, type_name: str, **network: object
) -> Iterator[Iterator[Any]]:
    """Yield the messages, of rosbags' types, that a node of DDS or Zenoh on the drone receives."""
    network_settings = {"address": emulation.robots[Role.RELAY].spec.ip, "node": "subscriber", **network}
    quality = offered_qos.LATCHED if topic == "/tf_static" else PROFILES["sensor_data"]
    description = topics.describe(standard_types(), topic, type_name, quality, domain=0, node="subscriber")
    command = (
        sys.executable,
        str(WIRE_END),
        "hear",
        middleware_name,
        json.dumps(network_settings),
        json.dumps(description),
    )
    with subprocess.Popen(
        drone_command(emulation, *command), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            yield (
                standard_types().ros2.deserialize_cdr(bytes.fromhex(line), description["type"])
                for line in process.stdout
            )
        finally:
            process.terminate()
            process.communicate()


def receive(emulation: EmulatedTestbed, middleware_name: str, topic: str, type_name: str, **network: object) -> Any:  # noqa: ANN401 (of rosbags)
    """Return the first message that a node on the drone receives."""
    with subscribed(emulation, middleware_name, topic, type_name, **network) as messages:
        return next(messages)


def stamp_s(message: Any) -> float:  # noqa: ANN401 (of rosbags)
    return float(message.header.stamp.sec + message.header.stamp.nanosec / 1e9)


@pytest.fixture(scope="module")
def report(multicast: EmulatedTestbed, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    """Return the report of a node of a real ROS 2 on the drone about the sender."""
    home = tmp_path_factory.mktemp("ros")
    words = (str(COUNT), *(f"{topic}={type_name}" for topic, type_name in RECEIVED.items()))
    command = drone_command(multicast, "env", f"ROS_HOME={home}", str(ROS2), str(LISTENER), *words)
    result = subprocess.run(command, capture_output=True, check=False)
    assert result.returncode == 0, result.stderr
    report: Mapping[str, Any] = json.loads(result.stdout)
    return report


@pytest.mark.emulated
def test_a_real_ros_2_lists_the_topics_with_their_types_and_hashes(report: Mapping[str, Any]) -> None:
    expected = {**RECEIVED, "/tf": "tf2_msgs/msg/TFMessage", "/tf_static": "tf2_msgs/msg/TFMessage"}
    assert {topic: report["types"].get(topic) for topic in expected} == {
        topic: [type_name] for topic, type_name in expected.items()
    }
    assert report["latched"] == ["TRANSIENT_LOCAL"]
    assert report["hashes"] == {
        topic: [standard_types().get(type_name).rihs01] for topic, type_name in expected.items()
    }


@pytest.mark.emulated
def test_a_real_ros_2_lists_the_node_and_its_topics(report: Mapping[str, Any]) -> None:
    assert NODES[Role.SENDER] in report["nodes"]
    topics_of_node = {topic for topic, _ in report["topics_of_nodes"][NODES[Role.SENDER]]}
    assert topics_of_node == {*RECEIVED, "/tf", "/tf_static", "/rosout"}


@pytest.mark.emulated
def test_a_real_ros_2_reads_the_node_s_log(report: Mapping[str, Any]) -> None:
    node_name = NODES[Role.SENDER]
    lines = [line for line in report["log"] if line["name"] == node_name]
    assert {f"{topic} has a subscriber" for topic in RECEIVED} <= {line["msg"] for line in lines}
    assert {line["level"] for line in lines} == {20}, "rcl_interfaces/msg/Log.INFO"
    assert all(0 <= time.time() - line["stamp"]["sec"] < LONG_S for line in lines)
    # One publisher is the robot's, one is that of the listener (rclpy).
    assert report["rosout"] == [["TRANSIENT_LOCAL", 10_000_000_000]] * 2


@pytest.mark.emulated
def test_the_documentation_describes_the_services_and_topics_that_the_node_lacks(report: Mapping[str, Any]) -> None:
    """The reference is a node of rclpy: the names of its services and topics start with the name of the node."""
    node_name = NODES[Role.SENDER]
    services_of_rclpy = {service.rpartition("/")[2] for service in report["services_of_node"]["listener"]}
    assert {"list_parameters", "get_type_description"} <= services_of_rclpy
    assert report["services_of_node"][node_name] == []
    topics_of_robot = {topic for topic, _ in report["topics_of_nodes"][node_name]}
    missing_topics = set(report["topics_of_listener"]) - topics_of_robot - {"/cmd_vel"}
    page = (ROOT / "docs" / "add-a-robot.md").read_text(encoding="utf-8")
    section = page.partition("### What its node lacks")[2].partition("\n## ")[0]
    assert [name for name in sorted(missing_topics) if f"`{name}`" not in section] == []
    assert "no services (for parameters and type descriptions)" in section
    assert all("parameter" in name or "type_description" in name for name in services_of_rclpy)
    assert "`/rosout`" in section


@pytest.mark.emulated
def test_a_real_ros_2_receives_the_right_values_over_the_medium(
    multicast: EmulatedTestbed, report: Mapping[str, Any]
) -> None:
    received_messages = report["messages"]
    for topic in RECEIVED:
        stamps_s = [
            message["header"]["stamp"]["sec"] + message["header"]["stamp"]["nanosec"] / 1e9
            for message in received_messages[topic]
        ]
        assert len(stamps_s) == COUNT
        assert all(0 <= time.time() - stamp_s < LONG_S for stamp_s in stamps_s), topic
    scan = received_messages["/scan"][0]
    assert scan["header"]["frame_id"] == "base_scan"
    assert scan["ranges"] == [math.inf] * 360, "the lawn has nothing within 3.5 m of the line"
    odom = received_messages["/odom"][0]
    assert (odom["header"]["frame_id"], odom["child_frame_id"]) == ("odom", "base_footprint")
    assert odom["pose"]["covariance"][:: 6 + 1] == list(ODOMETRY_VARIANCES)
    assert received_messages["/imu"][0]["linear_acceleration"]["z"] == pytest.approx(GRAVITY_M_S2, abs=0.2)
    battery = received_messages["/battery_state"][0]
    assert battery["percentage"] == pytest.approx(0.8)
    assert math.isnan(battery["current"])
    # A scan is 2.9 kB, in two fragments.
    assert multicast.medium.stats().ports["turtlebot-1"].sent_packets >= 2 * COUNT


@pytest.mark.emulated
def test_a_real_ros_2_drives_the_robot_by_its_velocity_topic(
    multicast: EmulatedTestbed, report: Mapping[str, Any]
) -> None:
    """The robot moves in its odometry, and in the world according to the medium."""
    assert report["types"]["/cmd_vel"] == ["geometry_msgs/msg/Twist"]
    assert report["driven_m"] >= DRIVEN_M
    places_m = [
        point.position_m for point in multicast.oracle.track(0) if point.role is Role.SENDER and point.position_m
    ]
    assert max(math.dist(places_m[0], place_m) for place_m in places_m) >= DRIVEN_M / 2


@pytest.mark.emulated
def test_odometry_received_by_another_robot_integrates_to_the_path(multicast: EmulatedTestbed) -> None:
    move = Move(Role.SENDER, (Leg(away_m=1.0), Leg(left_m=0.5)), speed_m_s=0.5)
    multicast.place(PLACED)  # an earlier test may have driven it
    with subscribed(multicast, "dds", "/odom", "nav_msgs/Odometry") as messages:
        first = next(messages)
        start, start_ns = first.pose.pose.position, time.time_ns()
        with multicast.moving(move):
            samples = [first, *takewhile(lambda message: message.pose.pose.position.y < start.y + 0.499, messages)]
            track = [point for point in multicast.oracle.track(start_ns) if point.role is Role.SENDER]
    x_m = y_m = 0.0
    for before, after in pairwise(samples):
        facing_rad = 2 * math.atan2(before.pose.pose.orientation.z, before.pose.pose.orientation.w)
        step_m = before.twist.twist.linear.x * (stamp_s(after) - stamp_s(before))
        x_m, y_m = x_m + step_m * math.cos(facing_rad), y_m + step_m * math.sin(facing_rad)
    end = samples[-1].pose.pose.position
    assert (x_m, y_m) == pytest.approx((end.x - start.x, end.y - start.y), abs=0.1)
    assert (x_m, y_m) == pytest.approx((1.0, 0.5), abs=0.1)
    start_m, end_m = (track[number].position_m for number in (0, -1))
    assert start_m is not None
    assert end_m is not None
    # The medium is updated every 0.1 m.
    assert math.dist(start_m[:2], end_m[:2]) == pytest.approx(math.hypot(x_m, y_m), abs=0.2)


@pytest.mark.emulated
def test_topics_return_after_the_sensors_were_killed(multicast: EmulatedTestbed) -> None:
    with subscribed(multicast, "dds", "/battery_state", "sensor_msgs/BatteryState") as messages:
        last_message = next(messages)
        multicast.inject(Fault(FaultKind.KILL, Role.SENDER, process="sensors"))
        kill_time_s = time.time()
        assert any(stamp_s(message) > kill_time_s for message in messages), f"none after {last_message}"
    # The relay continues: it has unsubscribed from the topic whose publisher exited.
    assert receive(multicast, "dds", "/odom", "nav_msgs/Odometry").child_frame_id == "base_footprint"


@pytest.mark.emulated
def test_zenoh_discovers_nodes_across_the_medium(multicast: EmulatedTestbed) -> None:
    message = receive(multicast, "zenoh", "/tf", "tf2_msgs/TFMessage")
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_footprint")


@pytest.mark.emulated
def test_unicast_peers_need_no_multicast() -> None:
    with lab(cast(sender="cyclonedds", receiver="zenoh"), "{discovery: peers}") as emulation:
        for role, middleware_name in ((Role.SENDER, "dds"), (Role.RECEIVER, "zenoh")):
            peers = (emulation.robots[role].spec.ip,)
            odom = receive(emulation, middleware_name, "/odom", "nav_msgs/Odometry", discovery="peers", peers=peers)
            assert odom.child_frame_id == "base_footprint"


@pytest.mark.emulated
def test_zenoh_works_with_a_router_on_the_relay() -> None:
    with lab(cast(sender="zenoh"), ROUTER) as emulation:
        relay = emulation.robots[Role.RELAY].spec.ip
        scan = receive(emulation, "zenoh", "/scan", "sensor_msgs/LaserScan", discovery="router", server=relay)
        assert np.isinf(scan.ranges).all()
        assert len(scan.ranges) == 360


@pytest.mark.emulated
@pytest.mark.parametrize("middleware_name", ["dds", "zenoh"])
def test_a_late_subscriber_receives_the_transforms_from_every_sensor_to_the_world(
    multicast: EmulatedTestbed, middleware_name: str
) -> None:
    """The parents lead from the frame of each message to the frame in which the robot was switched on, as in tf2."""
    parent_of = {
        transform.child_frame_id: transform.header.frame_id
        for topic in ("/tf_static", "/tf")
        for transform in receive(multicast, middleware_name, topic, "tf2_msgs/TFMessage").transforms
    }
    for topic in ros_of(load_profile("turtlebot3_burger")).topics:
        frame = topic.frame
        while frame in parent_of:
            frame = parent_of[frame]
        assert frame in {"odom", ""}, topic.name


def specs(robots: Cast, ros2: str, ros: str = "auto") -> Mapping[Role, Any]:
    make_spec = partial(robot_spec, robots, ros=RosChoice.BUILTIN, login=KeyPair.make(), host_key=KeyPair.make())
    return {role: make_spec(role, options=options(ros2, ros)) for role in robots}


def test_specifications_have_the_ros2_settings() -> None:
    specs_by_role = specs(cast(sender="cyclonedds", receiver="zenoh"), "{discovery: peers}")
    assert specs_by_role[Role.SENDER].ros2.peers == ("10.42.0.2", "10.42.0.3")
    assert (specs_by_role[Role.SENDER].ros2.middleware, specs_by_role[Role.RECEIVER].ros2.middleware) == (
        "dds",
        "zenoh",
    )
    assert specs_by_role[Role.RELAY].ros2 is None
    specs_by_role = specs(cast(sender="zenoh"), ROUTER)
    assert (specs_by_role[Role.SENDER].ros2.router, specs_by_role[Role.SENDER].ros2.peers) == ("10.42.0.3", ())
    assert [role for role in specs_by_role if specs_by_role[role].routes_zenoh] == [Role.RELAY]
    assert "zenoh_router" in [service.name for service in services.services(specs_by_role[Role.RELAY])]


def test_the_built_in_ros_sends_nothing_over_the_radio() -> None:
    assert specs(cast(sender="cyclonedds"), "{}", ros="builtin")[Role.SENDER].ros2 is None


def test_a_router_outside_the_cast_is_rejected() -> None:
    robots = {role: robot for role, robot in cast(sender="zenoh").items() if role is not Role.RELAY}
    with pytest.raises(
        ConfigurationError, match=r"emulated\.ros2\.router is duckiedrone-1, which is not in this trial"
    ):
        specs(robots, ROUTER)


@pytest.mark.parametrize(
    ("ros2", "message"),
    [
        ("{discovery: router}", "must be given together"),
        ("{router: duckiedrone-1}", "must be given together"),
        ("{discovery: router, router: drone}", "emulated.ros2.router names 'drone', which the lab does not have"),
        ("{discovery: magic}", "emulated.ros2.discovery"),
    ],
)
def test_wrong_options_are_reported(ros2: str, message: str) -> None:
    text = f"{DEFAULT_SITE.read_text(encoding='utf-8')}\nemulated: {{ros2: {ros2}}}\n"
    document = schema.parse(text, source="fieldkit.yaml")
    with pytest.raises(ConfigurationError, match=message):
        EmulatedBackend(schema.validate(document, Site), document)


@pytest.mark.parametrize(
    ("ros2", "profile", "message"),
    [
        (ROUTER, profile_with("cyclonedds"), "uses DDS, which has no router"),
        ("{}", profile_with("zenoh", ROS_DOMAIN_ID="150"), "the ports of ROS_DOMAIN_ID 150 of the profile"),
    ],
)
def test_unsupported_profiles_are_reported(
    ros2: str, profile: RobotProfile, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = f"{DEFAULT_SITE.read_text(encoding='utf-8')}\nemulated: {{ros2: {ros2}}}\n"
    document = schema.parse(text, source="fieldkit.yaml")
    backend = EmulatedBackend(schema.validate(document, Site), document)
    monkeypatch.setattr("fieldkit.backends.registry.load_profile", lambda _: profile)
    with pytest.raises(ConfigurationError, match=message):
        backend.cast(Topology.MASTER)
