"""The emulated robot's `ros2 bag record` writes ROS 2 bags and behaves like the original program."""

import io
import sqlite3
import sys
import tarfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import pytest
from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosDurability, QosReliability
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fieldkit.config.profiles import RobotProfile, load_profile
from fieldkit.config.schema import parse, validate
from fieldkit.config.site import Site
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FIXED_ROLES, Topology
from fieldkit.remote.command import with_environment
from fieldkit.remote.shell import Shell
from fieldkit.steps.variants import Recorder, Tool
from fieldkit.trial.check import tools
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.ros.ros2_bag import Rosbag2Recorder
from sim_backends.emulated.ros.tcpros import Header, Listener
from sim_backends.world.world import load_world
from tests.helpers.casts import ros_of

Robots = dict[str, Shell]
"""Robots by the ROS distribution that they run."""

# Runs a recorder in a new folder on the robot until it prints a text, signals its group, and packs its files.
DRIVER: Final = r"""
import json, os, pathlib, signal, subprocess, sys, tarfile, tempfile, time

number, until, for_s, *argv = sys.argv[1:]
folder = pathlib.Path(tempfile.mkdtemp())
os.chdir(folder)
with open("err", "wb") as err:
    process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stderr=err, start_new_session=True)
end = time.monotonic() + 60
while until not in pathlib.Path("err").read_text() and process.poll() is None:
    assert time.monotonic() < end, pathlib.Path("err").read_text()
    time.sleep(0.01)
if process.poll() is None:
    time.sleep(float(for_s))
    os.killpg(process.pid, int(number))
code = process.wait(60)
pathlib.Path("code").write_text(str(code))
with tarfile.open(fileobj=sys.stdout.buffer, mode="w|") as tar:
    tar.add(".")
"""


@dataclass(frozen=True)
class Recording:
    """Exit code and output of a recorder."""

    code: int
    output: str


def ros2_profile(distribution: str) -> RobotProfile:
    profile = load_profile("turtlebot3_burger")
    command = (
        ros_of(profile)
        .variants["ros2"]
        .model_copy(update={"distribution": distribution, "setup": (f"/opt/ros/{distribution}/setup.bash",)})
    )
    ros = ros_of(profile).model_copy(update={"variant": "ros2", "variants": {"ros2": command}})
    return profile.model_copy(update={"ros": ros})


@pytest.fixture(scope="module")
def robots() -> Iterator[Robots]:
    distributions = dict(zip(FIXED_ROLES, ("foxy", "humble", "jazzy"), strict=True))
    master = EmulatedBackend(None, None).cast(Topology.MASTER)
    cast = {
        role: master[role].model_copy(update={"profile": ros2_profile(name)}) for role, name in distributions.items()
    }
    # Debian's ROS is for robots with ROS 1; robots with ROS 2 always have the built-in recorder.
    with testbed.bring_up(
        cast, options=EmulatedOptions(), world=load_world("lawn"), ros=RosChoice.DEBIAN, seed=1
    ) as emulation:
        yield {name: emulation.shells[role] for role, name in distributions.items()}


def record(
    robots: Robots,
    distribution: str,
    target_folder: Path,
    argv: Sequence[str],
    *,
    signal: int = 2,
    until: str,
    for_s: float = 1.0,
) -> Recording:
    driver = (sys.executable, "-c", DRIVER, str(signal), until, str(for_s), "ros2", "bag", "record", *argv)
    command = with_environment(driver, setup=ros_of(ros2_profile(distribution)).command.setup)
    archive = robots[distribution].run(command, deadline=Deadline.after(180)).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(target_folder, filter="data")
    return Recording(int((target_folder / "code").read_text()), (target_folder / "err").read_text())


def scans(bag: Path, store: Stores) -> list[Any]:
    types = get_typestore(store)
    with Reader(bag) as reader:
        assert {connection.msgtype for connection in reader.connections} == {"sensor_msgs/msg/LaserScan"}
        return [types.deserialize_cdr(data, connection.msgtype) for connection, _, data in reader.messages()]


@pytest.mark.emulated
@pytest.mark.parametrize(
    ("distribution", "options", "file"),
    [
        ("foxy", [], "scan_0.db3"),
        ("humble", ["-s", "mcap"], "scan_0.mcap"),
        ("jazzy", [], "scan_0.mcap"),
        ("jazzy", ["-s", "sqlite3"], "scan_0.db3"),
    ],
)
def test_a_recording_is_a_complete_ros2_bag(
    robots: Robots, tmp_path: Path, distribution: str, options: list[str], file: str
) -> None:
    until = "All requested topics are subscribed"
    recording = record(robots, distribution, tmp_path, ["-o", "scan", *options, "/scan"], until=until, for_s=3.0)
    assert "Subscribed to topic '/scan'" in recording.output
    assert {path.name for path in (tmp_path / "scan").iterdir()} == {"metadata.yaml", file}
    messages = scans(tmp_path / "scan", Stores[f"ROS2_{distribution.upper()}"])
    assert len(messages) >= 2, "in three seconds of a 5 Hz laser"
    assert {len(scan.ranges) for scan in messages} == {360}
    assert {scan.header.frame_id for scan in messages} == {"base_scan"}
    stamps_s = [scan.header.stamp.sec + scan.header.stamp.nanosec / 1e9 for scan in messages]
    assert stamps_s == sorted(set(stamps_s))
    metadata = parse((tmp_path / "scan" / "metadata.yaml").read_text(), source="metadata.yaml").data
    information = metadata["rosbag2_bagfile_information"]
    assert information["relative_file_paths"] == [file]
    assert information["message_count"] == len(messages)
    (topic,) = information["topics_with_message_count"]
    offered = topic["topic_metadata"]["offered_qos_profiles"]
    # A text with rmw's numbers until Iron, names since Jazzy (rosbag2_storage/yaml.hpp).
    if distribution == "jazzy":
        assert information["version"] == 9
        assert [(profile["reliability"], profile["durability"]) for profile in offered] == [
            ("best_effort", "volatile")
        ]
    else:
        assert information["version"] == 8
        (profile,) = parse(offered, source="offered_qos_profiles").data
        assert (profile["reliability"], profile["durability"], profile["history"], profile["depth"]) == (2, 2, 3, 0)
        assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    content = (tmp_path / "scan" / file).read_bytes()
    if file.endswith(".mcap"):
        assert content.startswith(b"\x89MCAP0\r\n")
        assert content.endswith(b"\x89MCAP0\r\n")
    else:
        with closing(sqlite3.connect(tmp_path / "scan" / file)) as database:
            topics = "SELECT name, type, serialization_format FROM topics"
            assert database.execute(topics).fetchall() == [("/scan", "sensor_msgs/msg/LaserScan", "cdr")]
            ((stored_profiles,),) = database.execute("SELECT offered_qos_profiles FROM topics")
            written_profiles = parse(stored_profiles, source="topics").data
            assert written_profiles == (
                offered if distribution == "jazzy" else parse(offered, source="metadata").data
            )
            assert database.execute("SELECT count(*) FROM messages").fetchone() == (len(messages),)


@pytest.mark.emulated
@pytest.mark.parametrize(("distribution", "signal", "code"), [("foxy", 2, 2), ("foxy", 15, 0), ("jazzy", 2, 0)])
def test_the_exit_code_equals_that_of_the_distribution(
    robots: Robots, tmp_path: Path, distribution: str, signal: int, code: int
) -> None:
    argv = ["-o", "x", "/none"]
    recording = record(robots, distribution, tmp_path, argv, signal=signal, until="Listening", for_s=0.0)
    assert recording.code == code, recording.output
    with Reader(tmp_path / "x") as reader:
        assert reader.message_count == 0, "it has no publisher"


def offered_by(connection: Connection) -> tuple[QosReliability, QosDurability]:
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    (profile,) = connection.ext.offered_qos_profiles
    return profile.reliability, profile.durability


@pytest.mark.emulated
@pytest.mark.parametrize("arguments", [["-a"], ["--topics", "/scan", "odom", "tf", "imu", "battery_state"]])
def test_every_topic_of_a_turtlebot_can_be_recorded(robots: Robots, tmp_path: Path, arguments: list[str]) -> None:
    recording = record(robots, "jazzy", tmp_path, ["-o", "all", *arguments], until="Listening for topics", for_s=5.0)
    assert recording.code == 0, recording.output
    with Reader(tmp_path / "all") as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        offered = {connection.topic: offered_by(connection) for connection in reader.connections}
    rates_hz = {topic.name: topic.rate for topic in ros_of(ros2_profile("jazzy")).topics}
    if "-a" in arguments:
        rates_hz["/tf_static"] = 1  # one message in total, because it is latched
        assert counts["/tf_static"] == 1
        assert offered["/tf_static"] == (QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
    assert counts.keys() == rates_hz.keys()
    assert offered["/scan"] == (QosReliability.BEST_EFFORT, QosDurability.VOLATILE), "sensor_data"
    assert offered["/odom"] == (QosReliability.RELIABLE, QosDurability.VOLATILE)
    assert all(counts[topic] >= rate_hz for topic, rate_hz in rates_hz.items()), f"in five seconds: {counts}"


@pytest.mark.emulated
@pytest.mark.parametrize(
    ("arguments", "code", "output"),
    [
        (["-o", ".", "/scan"], 1, "Output folder '.' already exists."),
        (["-o", "scan"], 1, "topics or --all"),
        (["-o", "scan", "-s", "zip", "/scan"], 2, "invalid choice: 'zip'"),
        (["--duration=15", "-o", "scan", "/scan"], 2, "unrecognized arguments: --duration=15"),
    ],
)
def test_a_wrong_command_line_is_rejected(
    robots: Robots, tmp_path: Path, arguments: list[str], code: int, output: str
) -> None:
    recording = record(robots, "foxy", tmp_path, arguments, until="Listening")
    assert recording.code == code
    assert output in recording.output
    assert not (tmp_path / "scan").exists()


@pytest.mark.emulated
@pytest.mark.parametrize(
    ("distribution", "recorder"), [("foxy", Recorder.SQLITE3), ("humble", Recorder.SQLITE3), ("jazzy", Recorder.MCAP)]
)
def test_the_probe_detects_the_format_of_the_recorder(robots: Robots, distribution: str, recorder: Recorder) -> None:
    profile = ros2_profile(distribution)
    output = robots[distribution].run(tools.probe(profile, {Tool.RECORDER}), deadline=Deadline.after(180)).stdout
    assert tools.parse(output, profile).recorder is recorder


def test_debian_s_ros_is_not_ros2(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldkit.backends.registry.load_profile", lambda _: ros2_profile("foxy"))
    text = DEFAULT_SITE.read_text(encoding="utf-8")
    for choice in ("auto", "builtin", "debian"):
        document = parse(f"{text}\nemulated: {{ros: {choice}}}\n", source="fieldkit.yaml")
        backend = EmulatedBackend(validate(document, Site), document)
        if choice == "debian":
            with pytest.raises(ConfigurationError, match="requests Debian's ROS, which is ROS 1"):
                backend.cast(Topology.MASTER)
        else:
            assert backend.cast(Topology.MASTER)


def test_a_message_that_is_not_of_its_type_is_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # A recorder handles signals until its process exits; this process must still handle Ctrl-C after the test.
    monkeypatch.setattr(Listener, "_stop_on_signals", lambda _: None)
    header = cast("Header", {"topic": "/scan", "type": "sensor_msgs/LaserScan"})
    recorder = Rosbag2Recorder(["/scan"], tmp_path / "bag", StoragePlugin.SQLITE3, "humble")
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for _ in range(2):
            recorder._write(writer, header, b"\x01")
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "are not of type" in line)
    assert "Messages of topic '/scan' are not of type 'sensor_msgs/msg/LaserScan': " in line
