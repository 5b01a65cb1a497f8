"""Positions in bags that rosbags writes: all message types, frames, stamps, and the start of odometry."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.positions import position_files
from fieldkit.measure.positions.position_sources import PositionSource
from fieldkit.measure.positions.samples import PLACED, WGS84
from fieldkit.ros.bags import bag_positions

S = 10**9
BEGAN_NS = 1_795_348_800 * S
STORE = get_typestore(Stores.ROS1_NOETIC)
STORE2 = get_typestore(Stores.ROS2_FOXY)
TYPES: Any = STORE.types


def header(at_ns: int, frame: str, number: int = 0) -> Any:  # noqa: ANN401 (of rosbags)
    stamp = TYPES["builtin_interfaces/msg/Time"](*divmod(at_ns, S))
    return TYPES["std_msgs/msg/Header"](number, stamp, frame)


def pose(x: float, y: float, yaw: float) -> Any:  # noqa: ANN401 (of rosbags)
    point = TYPES["geometry_msgs/msg/Point"](x, y, 0.0)
    orientation = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return TYPES["geometry_msgs/msg/Pose"](point, orientation)


def odometry(at_ns: int, x: float, y: float, yaw: float = 0.0) -> Any:  # noqa: ANN401 (of rosbags)
    zero = TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](TYPES["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36))
    with_covariance = TYPES["geometry_msgs/msg/PoseWithCovariance"](pose(x, y, yaw), np.zeros(36))
    return TYPES["nav_msgs/msg/Odometry"](header(at_ns, "odom"), "base_footprint", with_covariance, twist)


def fix(at_ns: int, latitude: float, longitude: float, status: int = 0) -> Any:  # noqa: ANN401 (of rosbags)
    fix_status = TYPES["sensor_msgs/msg/NavSatStatus"](status, 1)
    place = (latitude, longitude, 520.0)
    return TYPES["sensor_msgs/msg/NavSatFix"](header(at_ns, "gps"), fix_status, *place, np.zeros(9), 0)


def transform(at_ns: int, x: float, y: float, child: str, frame: str = "map") -> Any:  # noqa: ANN401 (of rosbags)
    position = TYPES["geometry_msgs/msg/Vector3"](x, y, 0.0)
    pose_transform = TYPES["geometry_msgs/msg/Transform"](position, pose(0, 0, 0).orientation)
    return TYPES["geometry_msgs/msg/TransformStamped"](header(at_ns, frame), child, pose_transform)


def pose_stamped(at_ns: int, x: float, y: float, frame: str = "map") -> Any:  # noqa: ANN401 (of rosbags)
    return TYPES["geometry_msgs/msg/PoseStamped"](header(at_ns, frame), pose(x, y, 0.0))


def pose_with_covariance(at_ns: int, x: float, y: float) -> Any:  # noqa: ANN401 (of rosbags)
    with_covariance = TYPES["geometry_msgs/msg/PoseWithCovariance"](pose(x, y, 0.0), np.zeros(36))
    return TYPES["geometry_msgs/msg/PoseWithCovarianceStamped"](header(at_ns, "map"), with_covariance)


def write_bag(folder: Path, messages: Iterable[Any], topic: str = "/where", late_ns: int = 1000) -> Path:
    """Write a ROS 1 bag of messages that were received `late_ns` after their stamps."""
    path = folder / "track.bag"
    with rosbag1.Writer(path) as writer:
        connections: dict[str, Any] = {}
        for number, message in enumerate(messages):
            kind = message.__msgtype__
            if kind not in connections:
                connections[kind] = writer.add_connection(topic, kind, typestore=STORE)
            position = BEGAN_NS + number * S + late_ns
            writer.write(connections[kind], position, bytes(STORE.serialize_ros1(message, kind)))
    return path


@pytest.mark.parametrize(
    ("make_message", "frame", "places"),
    [
        (odometry, PLACED, [[0, 0, 0], [1, 2, 0]]),
        (pose_stamped, "frame map", [[0, 0, 0], [1, 2, 0]]),
        (pose_with_covariance, "frame map", [[0, 0, 0], [1, 2, 0]]),
        (lambda position, x, y: transform(position, x, y, "base"), "frame map", [[0, 0, 0], [1, 2, 0]]),
        (lambda position, x, y: fix(position, 48 + x, 11 + y), WGS84, [[48, 11, 520], [49, 13, 520]]),
    ],
)
def test_every_message_type_has_positions(
    tmp_path: Path, make_message: Callable[[int, float, float], Any], frame: str, places: list[list[float]]
) -> None:
    path = write_bag(tmp_path, [make_message(BEGAN_NS, 0.0, 0.0), make_message(BEGAN_NS + S, 1.0, 2.0)])
    samples = bag_positions.read_bag(path, PositionSource(topic="/where"))
    assert (samples.frame, samples.values.tolist()) == (frame, places)
    assert samples.times_ns.tolist() == [BEGAN_NS, BEGAN_NS + S]


def write_ros2_bag(folder: Path, message: Any, kind: str) -> Path:  # noqa: ANN401 (of rosbags)
    with rosbag2.Writer(folder / "track", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/where", kind, typestore=STORE2)
        writer.write(connection, BEGAN_NS, bytes(STORE2.serialize_cdr(message, kind)))
    (file,) = (folder / "track").glob("*.db3")
    return file


def transform2(x: float, y: float, frame: str, child: str) -> Any:  # noqa: ANN401 (of rosbags)
    types: Any = STORE2.types
    message_header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(BEGAN_NS, S)), frame)
    position, orientation = (
        types["geometry_msgs/msg/Vector3"](x, y, 0.0),
        types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    return types["geometry_msgs/msg/TransformStamped"](
        message_header, child, types["geometry_msgs/msg/Transform"](position, orientation)
    )


def test_ros_2_bags_and_the_child_frame_of_a_transform_tree(tmp_path: Path) -> None:
    kind = "tf2_msgs/msg/TFMessage"
    tree: Any = STORE2.types[kind]
    transforms = tree([transform2(1.0, 2.0, "world", "/base"), transform2(5.0, 5.0, "base", "wheel")])
    path = write_ros2_bag(tmp_path, transforms, kind)
    samples = bag_positions.read_bag(path, PositionSource(topic="/where", child="base"))
    assert (samples.frame, samples.values.tolist()) == ("frame world", [[1, 2, 0]])
    with pytest.raises(EvidenceError, match="has positions in several frames: base, world"):
        bag_positions.read_bag(path, PositionSource(topic="/where"))
    with pytest.raises(EvidenceError, match="no position in /where"):
        bag_positions.read_bag(path, PositionSource(topic="/where", child="roof"))


def test_messages_without_a_fix_and_with_equal_times_are_ignored(tmp_path: Path) -> None:
    without_fix, nan = fix(BEGAN_NS, 0.0, 0.0, status=-1), fix(BEGAN_NS + 2 * S, math.nan, 11.0)
    path = write_bag(tmp_path, [without_fix, fix(BEGAN_NS + S, 48.0, 11.0), fix(BEGAN_NS + S, 49.0, 11.0), nan])
    samples = bag_positions.read_bag(path, PositionSource(topic="/where"))
    assert (samples.times_ns.tolist(), samples.values.tolist()) == ([BEGAN_NS + S], [[48, 11, 520]])


def test_stamps_of_another_clock_are_rejected_unless_times_of_reception_are_used(tmp_path: Path) -> None:
    path = write_bag(tmp_path, [pose_stamped(7 * S, 1.0, 1.0)])
    with pytest.raises(EvidenceError, match="the stamps of /where differ by 1795348793 s from") as caught:
        bag_positions.read_bag(path, PositionSource(topic="/where"))
    assert caught.value.remedy == "write times: received, in the step"
    samples = bag_positions.read_bag(path, PositionSource(topic="/where", stamps="received"))
    assert samples.times_ns.tolist() == [BEGAN_NS + 1000]


@pytest.mark.parametrize(
    ("messages", "topic", "message"),
    [
        ([pose_stamped(BEGAN_NS, 0.0, 0.0)], "/other", "no position in /other"),
        ([TYPES["std_msgs/msg/String"]("here")], "/where", "contains no position"),
        ([pose_stamped(BEGAN_NS, 0.0, 0.0), pose_stamped(BEGAN_NS, 0.0, 0.0, "odom")], "/where", "frames: map, odom"),
        (
            [pose_stamped(BEGAN_NS, 0.0, 0.0), odometry(BEGAN_NS, 0.0, 0.0)],
            "/where",
            "/where has messages of several types: geometry_msgs/msg/PoseStamped, nav_msgs/msg/Odometry",
        ),
    ],
)
def test_topics_without_positions_are_rejected(tmp_path: Path, messages: list[Any], topic: str, message: str) -> None:
    with pytest.raises(EvidenceError, match=message):
        bag_positions.read_bag(write_bag(tmp_path, messages), PositionSource(topic=topic))


def test_odometry_is_transformed_to_the_robots_place_and_heading(tmp_path: Path) -> None:
    # The robot was driven before the step, so its odometry starts 5 m away and turned to the left.
    initial_pose = (5.0, 5.0, math.pi / 2)
    messages = [odometry(BEGAN_NS, *initial_pose), odometry(BEGAN_NS + S, 5.0, 7.0, math.pi / 2)]
    odometry_samples = bag_positions.read_bag(write_bag(tmp_path, messages), PositionSource(topic="/where"))
    position_source = PositionSource(
        topic="/where", start=(10.0, 0.0, 0.0), heading_rad=math.pi, began_utc_ns=BEGAN_NS + S // 2
    )
    samples = position_files.to_placement_frame(odometry_samples, position_source)
    assert samples.values == pytest.approx(np.array([[10, 0, 0], [8, 0, 0]]), abs=1e-9), "2 m ahead, facing back"
    late_source = PositionSource(topic="/where", heading_rad=0.0, began_utc_ns=BEGAN_NS - 3 * S)
    with pytest.raises(EvidenceError, match=r"/where begins 3\.0 s after the step started"):
        position_files.to_placement_frame(odometry_samples, late_source)
    with pytest.raises(EvidenceError, match="the robot's initial heading is unknown"):
        position_files.to_placement_frame(odometry_samples, PositionSource(topic="/where", began_utc_ns=BEGAN_NS))
