"""Emulated robots with ROS 1, read by other programs: a tf listener of rospy on the robot, and bagpy."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from rosbags.rosbag1 import Reader

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Fault, FaultKind, Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.remote.command import with_environment
from fieldkit.ros.interfaces.types import standard_types
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.ros.messages import LASER_NOISE_M, LASER_RANGE_M
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.world.world import load_world
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until

LISTENER: Final = Path(__file__).with_name("tf_listener.py")
BAGPY_CLIENT: Final = Path(__file__).with_name("bagpy_client.py")
BAGPY: Final = ROOT / ".bagpy"
"""Folder into which `.ci/install --dev` installs bagpy and its dependencies, separate from those of the tests."""
LONG_S: Final = 120.0
PLACED: Final = Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("5m"))
STAMPED: Final = ("/scan", "/odom", "/imu", "/battery_state")


@pytest.fixture(scope="module")
def emulation() -> Iterator[EmulatedTestbed]:
    robot = EmulatedBackend(None, None).cast(Topology.MASTERLESS)[Role.SENDER]
    with testbed.bring_up(
        {Role.SENDER: robot}, options=EmulatedOptions(), world=load_world("lawn"), ros=RosChoice.DEBIAN, seed=1
    ) as running:
        yield running


def run_in_ros(emulation: EmulatedTestbed, *argv: str) -> str:
    command = with_environment(argv, setup=emulation.robots[Role.SENDER].spec.setup)
    return emulation.shells[Role.SENDER].run(command, deadline=Deadline.after(LONG_S)).stdout.decode()


def tf_report(emulation: EmulatedTestbed) -> Any:  # noqa: ANN401 (of JSON)
    return json.loads(run_in_ros(emulation, "python3", str(LISTENER), "odom", *STAMPED))


@pytest.mark.emulated
def test_a_tf_listener_reaches_the_frame_of_every_header(emulation: EmulatedTestbed) -> None:
    report = tf_report(emulation)
    assert report["frames"] == {"/scan": "base_scan", "/odom": "odom", "/imu": "imu_link", "/battery_state": ""}
    assert report["reached"], report["paths"]
    assert report["paths"]["base_scan"] == ["base_scan", "base_link", "base_footprint", "odom"]
    assert report["paths"]["imu_link"] == ["imu_link", "base_link", "base_footprint", "odom"]
    assert report["latched"] == {"/tf": False, "/tf_static": True}
    assert report["rospy"].startswith("/usr/lib/python3/dist-packages/"), "Debian's, after PYTHONPATH"


@pytest.mark.emulated
def test_static_transforms_return_after_the_sensors_were_killed(emulation: EmulatedTestbed) -> None:
    emulation.inject(Fault(FaultKind.KILL, Role.SENDER, process="sensors"))
    assert tf_report(emulation)["reached"]
    emulation.inject(Fault(FaultKind.KILL, Role.SENDER, process="ros_relay"))
    wait_until(lambda: "/tf_static" in run_in_ros(emulation, "rostopic", "list"), Deadline.after(LONG_S))
    assert tf_report(emulation)["reached"]


@pytest.mark.emulated
def test_packages_of_fieldkit_s_python_precede_debian_s(emulation: EmulatedTestbed) -> None:
    """Both must be importable: middlewares of the Python that runs fieldkit, and rospy."""
    origin = "import numpy, rospy, sys; print(sys.executable); print(numpy.__file__)"
    executable, numpy = run_in_ros(emulation, "python3", "-c", origin).splitlines()
    assert not numpy.startswith("/usr/lib/python3/dist-packages/")
    assert Path(numpy).parents[1].name == "site-packages", executable


ONE_SCAN: Final = """
import json, rospy
from sensor_msgs.msg import LaserScan
rospy.init_node("scan_reader", anonymous=True, disable_signals=True)
print(json.dumps(rospy.wait_for_message("/scan", LaserScan, 60).ranges))
"""


@pytest.mark.emulated
def test_the_laser_detects_the_wall_next_to_the_sender(emulation: EmulatedTestbed) -> None:
    """The sender is at (3, 18) and faces west; the wall is 0.9 m behind it, from 4 m south to 4 m north."""
    emulation.place(Placement(Scenario.NLOS, Topology.MASTERLESS, parse_distance("5m")))
    ranges_m = json.loads(run_in_ros(emulation, "python3", "-c", ONE_SCAN))
    assert len(ranges_m) == 360
    for beam, range_m in enumerate(ranges_m):
        angle_rad = math.radians(beam - 180)
        true_m = 0.9 / math.cos(angle_rad) if math.cos(angle_rad) > 0 else math.inf
        # At the greatest distance, noise decides between a range and infinity.
        if abs(true_m - LASER_RANGE_M[1]) > 6 * LASER_NOISE_M:
            expected_m = true_m if true_m < LASER_RANGE_M[1] else math.inf
            assert range_m == pytest.approx(expected_m, abs=6 * LASER_NOISE_M), beam
    emulation.place(PLACED)
    assert set(json.loads(run_in_ros(emulation, "python3", "-c", ONE_SCAN))) == {math.inf}


@pytest.mark.emulated
def test_bagpy_reads_a_recording_as_rosbags_does(emulation: EmulatedTestbed, tmp_path: Path) -> None:
    topics = ("/scan", "/odom", "/tf", "/tf_static", "/imu", "/battery_state")
    run_in_ros(emulation, "rosbag", "record", "--duration=3", "-O", "clients", *topics)
    bag = tmp_path / "clients.bag"
    emulation.shells[Role.SENDER].fetch(
        ("cat", "clients.bag"), bag, deadline=Deadline.after(LONG_S), limit_bytes=1 << 22
    )
    with Reader(bag) as reader:
        types = {connection.topic: connection.msgtype.replace("/msg/", "/") for connection in reader.connections}
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        connections = [connection for connection in reader.connections if connection.topic == "/odom"]
        store = standard_types().ros1
        odom: list[Any] = [
            store.deserialize_ros1(data, connection.msgtype)
            for connection, _, data in reader.messages(connections=connections)
        ]
    assert set(counts) == set(topics)
    assert counts["/tf_static"] == 1

    command = (sys.executable, str(BAGPY_CLIENT), str(bag), "/odom")
    environment = os.environ | {"PYTHONPATH": str(BAGPY)}
    result = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    bagpy_report = json.loads(result.stdout.splitlines()[-1])
    assert bagpy_report["topics"] == {topic: [types[topic], counts[topic]] for topic in topics}
    rows = [dict(zip(bagpy_report["columns"], row, strict=True)) for row in bagpy_report["rows"]]
    assert [int(row["header.stamp.nsecs"]) for row in rows] == [message.header.stamp.nanosec for message in odom]
    for row, message in zip(rows, odom, strict=True):
        assert (row["header.frame_id"], row["child_frame_id"]) == ("odom", "base_footprint")
        assert float(row["pose.pose.orientation.w"]) == message.pose.pose.orientation.w
        assert float(row["twist.twist.angular.z"]) == message.twist.twist.angular.z
