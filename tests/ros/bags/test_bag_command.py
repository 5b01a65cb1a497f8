"""`fieldkit bag`: its output for complete, truncated and damaged bags, some of them from recorders of ROS."""

import gzip
import json
import os
import random
import shutil
import sqlite3
import subprocess
from collections.abc import Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from fieldkit.cli import main
from fieldkit.core.errors import EvidenceError
from fieldkit.ros.bags import bag_command, contents
from fieldkit.ros.bags.bag import METADATA
from fieldkit.ros.bags.formats import BagFormat
from fieldkit.ros.bags.worker import message_types
from tests.helpers.paths import DATA

KILLED = DATA / "rosbag/1.15.15/killed"
STARTED_NS = 1_795_000_000_000_000_000
TYPES = get_typestore(Stores.ROS2_JAZZY)
Message = tuple[str, int, str]


def expected(count: int) -> list[Message]:
    draw = random.Random(count)
    return [
        (f"/t{number % 3}", STARTED_NS + number * 10_000_000, "x" * draw.randrange(2000) + str(number))
        for number in range(count)
    ]


def write_bag(folder: Path, form: BagFormat, messages: Sequence[Message]) -> Path:
    """Write a bag with rosbags; a ROS 1 bag is compressed and has about 20 messages per chunk."""
    if form is BagFormat.ROS1:
        types = get_typestore(Stores.ROS1_NOETIC)
        path = folder / "all.bag"
        ros1_writer = rosbag1.Writer(path)
        ros1_writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        ros1_writer.chunk_threshold = 20_000
        with ros1_writer:
            channels = {
                topic: ros1_writer.add_connection(topic, "std_msgs/msg/String", typestore=types)
                for topic, *_ in messages[:3]
            }
            string = types.types["std_msgs/msg/String"]
            for topic, at_ns, text in messages:
                ros1_writer.write(
                    channels[topic], at_ns, types.serialize_ros1(string(data=text), "std_msgs/msg/String")
                )
        return path
    path = folder / "all"
    if form is BagFormat.MCAP and len(messages) > 100:
        return write_in_chunks(path, messages)
    plugin = rosbag2.StoragePlugin.MCAP if form is BagFormat.MCAP else rosbag2.StoragePlugin.SQLITE3
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as ros2_writer:
        connections = {
            topic: ros2_writer.add_connection(topic, "std_msgs/msg/String", typestore=TYPES)
            for topic, *_ in messages[:3]
        }
        string = TYPES.types["std_msgs/msg/String"]
        for topic, at_ns, text in messages:
            ros2_writer.write(
                connections[topic], at_ns, TYPES.serialize_cdr(string(data=text), "std_msgs/msg/String")
            )
    return path


def write_in_chunks(
    path: Path, messages: Sequence[Message], compression: CompressionType = CompressionType.ZSTD
) -> Path:
    """Write an MCAP file with about 20 messages per chunk; rosbags would write one chunk."""
    path.mkdir()
    with (path / "all.mcap").open("wb") as file_object:
        writer = McapWriter(file_object, chunk_size=20_000, compression=compression)
        writer.start(profile="ros2")
        definition, _ = TYPES.generate_msgdef("std_msgs/msg/String", ros_version=2)
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", definition.encode())
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic, *_ in messages[:3]}
        for topic, at_ns, text in messages:
            data = TYPES.serialize_cdr(TYPES.types["std_msgs/msg/String"](data=text), "std_msgs/msg/String")
            writer.add_message(channels[topic], at_ns, bytes(data), at_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def read(path: Path) -> list[Message]:
    with AnyReader([path]) as reader:
        return [
            (connection.topic, at_ns, reader.deserialize(data, connection.msgtype).data)  # type: ignore[attr-defined]
            for connection, at_ns, data in reader.messages()
        ]


def data_file(bag: Path) -> Path:
    return bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix in {".db3", ".mcap"})


@pytest.mark.parametrize("form", BagFormat)
def test_a_complete_bag_is_described_and_intact(
    tmp_path: Path, form: BagFormat, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path, form, expected(31))
    assert main(["bag", "info", str(bag), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["format"], report["messages"], report["problems"]) == (form.value, 31, [])
    assert report["started_utc_ns"] == STARTED_NS
    assert report["duration_s"] == pytest.approx(0.3)
    assert [topic["messages"] for topic in report["topics"]] == [11, 10, 10]
    assert main(["bag", "info", str(bag)]) == 0
    assert "/t1" in capsys.readouterr().out
    assert main(["bag", "check", str(bag)]) == 0
    assert capsys.readouterr().out == f"{bag}: intact, 31 messages\n"


@pytest.mark.parametrize("form", BagFormat)
@pytest.mark.parametrize("share", [0.35, 0.8, 0.97])
def test_the_start_of_a_truncated_file_is_recovered(tmp_path: Path, form: BagFormat, share: float) -> None:
    messages = expected(300)
    bag = write_bag(tmp_path, form, messages)
    file = data_file(bag)
    with file.open("r+b") as file_object:
        file_object.truncate(int(share * file.stat().st_size))
    assert main(["bag", "check", str(bag)]) == EvidenceError.exit_code
    repaired_bag = tmp_path / ("saved.bag" if form is BagFormat.ROS1 else "saved")
    if form is BagFormat.SQLITE:
        # The pages of a database are a tree, so a truncated database may contain no readable message.
        assert main(["bag", "repair", str(bag), str(repaired_bag)]) in {0, EvidenceError.exit_code}
    else:
        assert main(["bag", "repair", str(bag), str(repaired_bag)]) == 0
    recovered = read(repaired_bag) if repaired_bag.exists() else []
    assert recovered == messages[: len(recovered)]
    if form is not BagFormat.SQLITE:
        assert len(recovered) > (share - 0.25) * len(messages)
    assert {path.name for path in tmp_path.iterdir()} <= {bag.name, repaired_bag.name}


@pytest.mark.parametrize(
    ("name", "count"),
    [("open.bag.active", 266), ("bz2.bag.active", 225), ("lz4.bag.active", 225)],
)
def test_at_least_as_many_messages_are_recovered_as_by_ros(
    tmp_path: Path, name: str, count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """`rosbag reindex` 1.15.15 recovers 0, 225 and 225 messages of these bags."""
    repaired_bag = tmp_path / "saved.bag"
    assert main(["bag", "check", str(KILLED / name)]) == EvidenceError.exit_code
    assert f"{count} messages can be recovered: fieldkit bag repair" in capsys.readouterr().err
    assert main(["bag", "repair", str(KILLED / name), str(repaired_bag)]) == 0
    recovered = read(repaired_bag)
    assert len(recovered) == count
    assert {(topic, text) for topic, _, text in recovered} == {("/chatter", "hello hello hello hello")}
    gaps_ns = sorted(after_ns - before_ns for (_, before_ns, _), (_, after_ns, _) in pairwise(recovered))
    assert gaps_ns[len(gaps_ns) // 2] == pytest.approx(20e6, rel=0.05), "50 Hz"


@pytest.mark.emulated
def test_ros_reads_a_repaired_bag(tmp_path: Path) -> None:
    repaired_bag = tmp_path / "saved.bag"
    contents.repair(KILLED / "open.bag.active", repaired_bag)
    report = subprocess.run(
        ("rosbag", "info", "-y", str(repaired_bag)), check=True, capture_output=True, text=True
    ).stdout
    assert "messages: 266" in report
    assert "indexed: True" in report


def test_write_ahead_log_of_a_killed_ros_2_recorder_is_recovered(tmp_path: Path) -> None:
    messages = expected(40)
    bag = write_bag(tmp_path, BagFormat.SQLITE, messages)
    file, remaining = data_file(bag), tmp_path / "left"
    remaining.mkdir()
    with closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA wal_autocheckpoint=0")
        data = bytes(TYPES.serialize_cdr(TYPES.types["std_msgs/msg/String"](data="late"), "std_msgs/msg/String"))
        database.execute(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", (STARTED_NS + 10**9, data)
        )
        database.commit()
        for path in bag.glob("*.db3*"):
            shutil.copyfile(path, remaining / path.name)
    before = {path.name: path.read_bytes() for path in remaining.iterdir()}
    report = contents.inspect(remaining)
    assert report.problems == (
        "there is no metadata.yaml: the recorder was killed before it closed the bag, or this file was lost",
    )
    assert report.recoverable_messages == 41
    contents.repair(remaining, tmp_path / "saved")
    assert [text for _, _, text in read(tmp_path / "saved")] == [*(text for _, _, text in messages), "late"]
    assert {path.name: path.read_bytes() for path in remaining.iterdir()} == before, (
        "the original files are not changed"
    )


@pytest.mark.parametrize("form", BagFormat)
@pytest.mark.parametrize("to", BagFormat)
def test_a_converted_bag_has_all_messages(tmp_path: Path, form: BagFormat, to: BagFormat) -> None:
    messages = expected(30)
    bag = write_bag(tmp_path, form, messages)
    new = tmp_path / ("new.bag" if to is BagFormat.ROS1 else "new")
    storage = () if to is BagFormat.ROS1 else ("--storage", to.value)
    assert main(["bag", "convert", str(bag), str(new), *storage]) == 0
    assert contents.inspect(new, read_all=True).problems == ()
    assert contents.inspect(new).format is to
    assert read(new) == messages


def test_types_are_those_of_the_distribution(tmp_path: Path) -> None:
    """The fields D, K, R, P of CameraInfo are named d, k, r, p in ROS 2."""
    types = get_typestore(Stores.ROS1_NOETIC)
    bag = tmp_path / "camera.bag"
    with rosbag1.Writer(bag) as writer:
        connection = writer.add_connection("/camera_info", "sensor_msgs/msg/CameraInfo", typestore=types)
        type_names = types.types
        header = type_names["std_msgs/msg/Header"](7, type_names["builtin_interfaces/msg/Time"](3, 4), "camera")
        region = type_names["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False)
        numbers = np.arange(12.0)
        info = type_names["sensor_msgs/msg/CameraInfo"](
            header, 480, 640, "plumb_bob", numbers[:5], numbers[:9], numbers[:9], numbers, 0, 0, region
        )
        writer.write(connection, STARTED_NS, types.serialize_ros1(info, "sensor_msgs/msg/CameraInfo"))
    contents.convert(bag, tmp_path / "camera", distribution="humble")
    with AnyReader([tmp_path / "camera"]) as reader:
        ((recorded, _, data),) = reader.messages()
        recovered = reader.deserialize(data, recorded.msgtype)
        assert recorded.digest == get_typestore(Stores.ROS2_HUMBLE).hash_rihs01("sensor_msgs/msg/CameraInfo")
    assert list(recovered.k) == list(numbers[:9])  # type: ignore[attr-defined]


@pytest.fixture
def work_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "code", "output_text"),
    [
        (("info", "nowhere.bag"), 2, "nowhere.bag: the bag cannot be read: No such file or directory"),
        (("info", "circle.bag"), 2, "circle.bag: the bag cannot be read: Too many levels of symbolic links"),
        (("info", "x" * 300), 2, "File name too long"),
        (("info", "none"), 2, "there is no bag in this folder"),
        (("info", "pipe.bag"), 2, "this is neither a file nor a folder"),
        (("info", "text.bag"), 2, "this is not a bag of ROS 1, SQLite or MCAP"),
        (("info", "packed.bag.gz"), 2, "remedy: gunzip -k packed.bag.gz, then try again"),
        (("info", "all.db3"), 2, "remedy: mv all.db3 all.db3.bag"),
        (("info", "empty.bag"), 4, "the file is empty"),
        (("info", "zeros.mcap"), 4, "the file begins with zeros"),
        (("info", "."), 2, "this folder contains several bags"),
        (("check", "nowhere.bag"), 2, "No such file"),
        (("check", "nowhere.bag", "killed.bag", "all.bag"), 4, "225 messages can be recovered"),
        (("repair", "nowhere.bag", "new.bag"), 2, "No such file"),
        (("repair", "zeros.mcap", "new"), 4, "the file begins with zeros"),
        (("convert", "nowhere.bag", "new"), 2, "No such file"),
        (("convert", "none", "new"), 2, "there is no bag in this folder"),
        (("repair", "all.bag", "all.bag"), 2, "it exists already"),
        (("repair", "all.bag", "new"), 2, "a repaired bag keeps its format, ros1: the new one must be NAME.bag"),
        (("convert", "all.bag", "no/new"), 2, "cannot write there"),
        (("convert", "all.bag", "new.bag", "--distribution", "humble"), 2, "humble is ROS 2"),
        (("convert", "killed.bag", "new"), 4, "remedy: fieldkit bag repair killed.bag NEW"),
    ],
    ids=lambda connection: " ".join(connection) if isinstance(connection, tuple) else "",
)
def test_impossible_requests_are_reported(
    work_folder: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], code: int, output_text: str
) -> None:
    write_bag(work_folder, BagFormat.ROS1, expected(5))
    Path("text.bag").write_text("a text")
    Path("packed.bag.gz").write_bytes(gzip.compress(b"a bag"))
    Path("empty.bag").touch()
    Path("none").mkdir()
    Path("circle.bag").symlink_to("circle.bag")
    os.mkfifo("pipe.bag")
    shutil.copyfile("all.bag", "all.db3")
    Path("zeros.mcap").write_bytes(bytes(1000))
    shutil.copyfile(KILLED / "bz2.bag.active", "killed.bag")
    names = {path.name for path in work_folder.iterdir()}
    assert main(["bag", *words]) == code
    assert output_text in capsys.readouterr().err
    assert {path.name for path in work_folder.iterdir()} == names, "no file remains"


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.NONE])
def test_single_mcap_file_is_a_bag(
    tmp_path: Path, compression: CompressionType, capsys: pytest.CaptureFixture[str]
) -> None:
    """The index is in the file, so no other file is needed to check it and to read its contents."""
    messages = expected(300)
    mcap_file = data_file(write_in_chunks(tmp_path / "all", messages, compression))
    assert not (mcap_file.parent / METADATA).exists()
    for path in (mcap_file, mcap_file.parent):
        assert main(["bag", "check", str(path)]) == 0
        assert "intact, 300 messages" in capsys.readouterr().out
    assert main(["bag", "convert", str(mcap_file.parent), str(tmp_path / "new.bag")]) == 0
    assert read(tmp_path / "new.bag") == messages
    capsys.readouterr()
    with mcap_file.open("r+b") as file_object:
        file_object.truncate(mcap_file.stat().st_size // 2)
    assert main(["bag", "check", str(mcap_file)]) == EvidenceError.exit_code
    output_text = capsys.readouterr().err
    assert "there is no metadata.yaml" in output_text
    assert "bytes before the end of a record" in output_text
    assert "messages can be recovered: fieldkit bag repair" in output_text


def test_remedy_for_a_truncated_database(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    database = data_file(write_bag(tmp_path, BagFormat.SQLITE, expected(300)))
    truncated_file = tmp_path / "cut.db3"
    truncated_file.write_bytes(database.read_bytes()[:30_000])
    assert main(["bag", "check", str(truncated_file)]) == EvidenceError.exit_code
    output_text = capsys.readouterr().err
    assert "there is no metadata.yaml" in output_text
    assert f"{truncated_file}: database disk image is malformed" in output_text
    assert (
        "no message can be recovered; SQLite may read more of it: sqlite3 OLD.db3 .recover | sqlite3 NEW.db3"
        in output_text
    )
    assert main(["bag", "repair", str(truncated_file), str(tmp_path / "new")]) == EvidenceError.exit_code
    assert "remedy: SQLite may read more of it" in capsys.readouterr().err


def test_sparse_file_is_reported_in_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = data_file(write_in_chunks(tmp_path / "all", expected(300)))
    with bag.open("r+b") as file_object:
        file_object.truncate(1 << 42)
    assert main(["bag", "check", str(bag)]) == EvidenceError.exit_code
    assert "can be recovered" in capsys.readouterr().err


def test_command_line_accepts_all_distributions_of_the_library() -> None:
    assert all(
        "sensor_msgs/msg/LaserScan" in message_types(connection).fielddefs for connection in bag_command.DISTRIBUTIONS
    )
    assert set(bag_command.STORAGES) == set(BagFormat) - {BagFormat.ROS1}
