"""Battery charge in ROS 1 and ROS 2 bags with several battery messages."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from fieldkit.core.errors import EvidenceError
from fieldkit.ros.bags.bag import battery_share

TOPIC = "/battery_state"
TYPE = "sensor_msgs/msg/BatteryState"


def message(store: Stores, percentage: float) -> object:
    types = get_typestore(store).types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    sequence_field = {"seq": 0} if store is Stores.ROS1_NOETIC else {}
    return types[TYPE](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **sequence_field),
        voltage=11.1,
        temperature=math.nan,
        current=math.nan,
        charge=math.nan,
        capacity=math.nan,
        design_capacity=1.8,
        percentage=percentage,
        power_supply_status=2,
        power_supply_health=1,
        power_supply_technology=3,
        present=True,
        cell_voltage=np.zeros(0, np.float32),
        cell_temperature=np.zeros(0, np.float32),
        location="",
        serial_number="",
    )


def ros1(folder: Path, percentages: Sequence[float]) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    path = folder / "scan.bag"
    with rosbag1.Writer(path) as writer:
        connection = writer.add_connection(TOPIC, TYPE, typestore=store)
        for at, percentage in enumerate(percentages):
            writer.write(connection, at, store.serialize_ros1(message(Stores.ROS1_NOETIC, percentage), TYPE))
    return path


def ros2(folder: Path, percentages: Sequence[float], storage: StoragePlugin) -> Path:
    store = get_typestore(Stores.ROS2_FOXY)
    with rosbag2.Writer(folder / "scan", version=8, storage_plugin=storage) as writer:
        connection = writer.add_connection(TOPIC, TYPE, typestore=store)
        for at, percentage in enumerate(percentages):
            writer.write(connection, at, store.serialize_cdr(message(Stores.ROS2_FOXY, percentage), TYPE))
    (path,) = (file for file in (folder / "scan").iterdir() if file.suffix in {".db3", ".mcap"})
    return path


@pytest.mark.parametrize(
    ("percentages", "share"),
    [([0.9, 0.8], 0.8), ([1.09], 1.0), ([55.0], 0.55), ([0.0], 0.0), ([math.nan], None), ([-1.0], None), ([], None)],
)
def test_the_last_message_has_the_charge(tmp_path: Path, percentages: list[float], share: float | None) -> None:
    assert battery_share(ros1(tmp_path, percentages), TOPIC) == pytest.approx(share)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_the_last_message_of_a_ros_2_bag_has_the_charge(tmp_path: Path, storage: StoragePlugin) -> None:
    assert battery_share(ros2(tmp_path, [0.9, 0.25], storage), TOPIC) == pytest.approx(0.25)


def test_another_topic_has_no_charge(tmp_path: Path) -> None:
    assert battery_share(ros1(tmp_path, [0.5]), "/odom") is None


def test_a_truncated_bag_is_an_error(tmp_path: Path) -> None:
    path = ros1(tmp_path, [0.5])
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(EvidenceError, match="cannot be read"):
        battery_share(path, TOPIC)
