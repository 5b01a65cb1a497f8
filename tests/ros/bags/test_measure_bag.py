import contextlib
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from fieldkit.core.errors import EvidenceError
from fieldkit.ros.bags import bag


def write_bag(path: Path, topics: dict[str, int], period_s: float = 0.2) -> Path:
    """Write a ROS 1 bag with the given number of messages per topic."""
    store = get_typestore(Stores.ROS1_NOETIC)
    message_type = "std_msgs/msg/String"
    message = store.types[message_type](data="x" * 100)
    with Writer(path) as writer:
        for topic, count in topics.items():
            connection = writer.add_connection(topic, message_type, typestore=store)
            for index in range(count):
                stamp = 1_700_000_000_000_000_000 + round(index * period_s * 1e9)
                writer.write(connection, stamp, bytes(store.serialize_ros1(message, message_type)))
    return path


def test_the_contents_of_a_bag_are_counted(tmp_path: Path) -> None:
    contents = bag.read(write_bag(tmp_path / "scan.bag", {"/scan": 74, "/odom": 3}))
    assert contents.messages == 77
    assert dict(contents.messages_by_topic) == {"/scan": 74, "/odom": 3}
    assert contents.duration_s == 14.6


def test_a_ros_1_bag_is_read_without_the_imports_for_ros_2(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "scan.bag", {"/scan": 2})
    script = f"""
import sys
from fieldkit.ros.bags import bag_reader
print(bag_reader.answer({{"path": {str(path)!r}}})["messages"], {{"ruamel", "sqlite3"}} & set(sys.modules))
"""
    completed = subprocess.run(
        (sys.executable, "-c", script), stdout=subprocess.PIPE, text=True, timeout=60, check=True
    )
    assert completed.stdout == "2 set()\n"


def test_a_bag_truncated_at_any_byte_is_rejected_with_a_remedy(tmp_path: Path) -> None:
    content = write_bag(tmp_path / "scan.bag", {"/scan": 5}).read_bytes()
    truncated_bag = tmp_path / "cut.bag"
    for size in range(0, len(content), 37):
        truncated_bag.write_bytes(content[:size])
        with pytest.raises(EvidenceError) as caught:
            bag.read(truncated_bag)
        assert caught.value.remedy
        assert caught.value.where == str(truncated_bag)


def test_an_unindexed_bag_is_rejected(tmp_path: Path) -> None:
    """A killed recorder leaves a header with index position 0."""
    path = write_bag(tmp_path / "scan.bag", {"/scan": 5})
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    with pytest.raises(EvidenceError, match="not indexed") as caught:
        bag.read(path)
    assert "fieldkit bag repair" in caught.value.remedy


def test_a_bag_without_messages_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="contains no message"):
        bag.read(write_bag(tmp_path / "scan.bag", {"/scan": 0}))


def test_a_relative_path_uses_the_current_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for count, name in enumerate(("here", "there"), start=1):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        assert bag.read(write_bag(Path("scan.bag"), {"/scan": count})).messages == count


def test_a_missing_bag_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="there is no bag"):
        bag.read(tmp_path / "scan.bag")


def test_flipped_bytes_are_rejected_or_read_without_other_exceptions(tmp_path: Path) -> None:
    content = write_bag(tmp_path / "scan.bag", {"/scan": 2}).read_bytes()
    path = tmp_path / "flipped.bag"
    random = np.random.default_rng(5)
    # Only the header, without its padding, and the index at the end are read.
    positions = [*range(120), *range(4100, len(content))]
    for at in random.choice(positions, 400, replace=False):
        data = bytearray(content)
        data[at] ^= 1 << int(random.integers(8))
        path.write_bytes(data)
        with contextlib.suppress(EvidenceError):
            bag.read(path)


SUFFIXES = {"db3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}


def write_ros2_bag(folder: Path, suffix: str, topics: dict[str, int], period_s: float = 0.2) -> Path:
    """Write a ROS 2 bag with the given number of messages per topic; return its data file, named as in ROS 2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    message_type = "std_msgs/msg/String"
    message = bytes(store.serialize_cdr(store.types[message_type](data="x" * 100), message_type))
    with rosbag2.Writer(folder, version=8, storage_plugin=SUFFIXES[suffix]) as writer:
        for topic, count in topics.items():
            connection = writer.add_connection(topic, message_type, typestore=store)
            for index in range(count):
                writer.write(connection, 1_700_000_000_000_000_000 + round(index * period_s * 1e9), message)
    path = folder / f"{folder.name}_0.{suffix}"
    (folder / f"{folder.name}.{suffix}").rename(path)
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f"{folder.name}.{suffix}", path.name))
    return path


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_ros2_bag_has_the_same_contents_as_a_ros1_bag(suffix: str, tmp_path: Path) -> None:
    topics = {"/scan": 74, "/odom": 3}
    ros1 = bag.read(write_bag(tmp_path / "scan.bag", topics))
    assert bag.read(write_ros2_bag(tmp_path / "scan", suffix, topics)) == ros1


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_ros2_bag_of_a_killed_recorder_is_an_error(suffix: str, tmp_path: Path) -> None:
    path = write_ros2_bag(tmp_path / "scan", suffix, {"/scan": 5})
    (path.parent / "metadata.yaml").unlink()
    with pytest.raises(EvidenceError, match=r"no metadata.yaml: its recorder was killed") as caught:
        bag.read(path)
    assert "fieldkit bag repair" in caught.value.remedy


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_ros2_bag_without_messages_is_rejected(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="contains no message") as caught:
        bag.read(write_ros2_bag(tmp_path / "scan", suffix, {"/scan": 0}))
    assert "ros2 topic hz" in caught.value.remedy


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_contradicts_its_metadata_is_rejected(suffix: str, tmp_path: Path) -> None:
    path = write_ros2_bag(tmp_path / "scan", suffix, {"/scan": 5})
    other = write_ros2_bag(tmp_path / "other" / "scan", suffix, {"/scan": 4})
    shutil.copy(other, path)
    with pytest.raises(EvidenceError, match=r"contains 4 messages, but metadata.yaml states 5"):
        bag.read(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("damaged", ["file", "metadata"])
def test_a_damaged_ros2_bag_is_rejected_or_read_without_other_exceptions(
    suffix: str, damaged: str, tmp_path: Path
) -> None:
    path = write_ros2_bag(tmp_path / "scan", suffix, {"/scan": 3, "/odom": 2})
    target = path if damaged == "file" else path.parent / "metadata.yaml"
    content = target.read_bytes()
    random = np.random.default_rng(5)
    for _ in range(150):
        data = bytearray(content)
        data[random.integers(len(data))] ^= 1 << int(random.integers(8))
        target.write_bytes(data)
        with contextlib.suppress(EvidenceError):
            bag.read(path)
    for size in random.integers(0, len(content) * 9 // 10, 20):
        target.write_bytes(content[:size])
        with pytest.raises(EvidenceError) as caught:
            bag.read(path)
        assert caught.value.remedy
