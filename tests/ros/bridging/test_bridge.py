"""`fieldkit bridge` between ROS 1 on one host, and DDS or Zenoh on another."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldkit import cli
from fieldkit.agent.messaging import middleware
from fieldkit.agent.messaging.middleware import ADAPTERS, Deliver, Network, Topic
from fieldkit.ros.bridging import bridge
from fieldkit.ros.bridging.bridge import Side
from fieldkit.ros.bridging.bridge_command import MIDDLEWARES
from fieldkit.ros.bridging.crossings import Crossing, parse_qos
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from tests.helpers.nightly import mark_nightly
from tests.helpers.two_hosts import TestHost, two_connected_hosts

TYPE = "sensor_msgs/msg/LaserScan"
SCAN = "/scan:sensor_msgs/LaserScan"
DOMAIN = 5
FIRST_WIRE_NUMBER = 1000
"""Number of the first scan from the side without ROS 1."""
NODES = Path(__file__).parent
"""Folder of the programs of the nodes."""
LIMIT_S = 90
"""Time limit of all nodes, so that the test of a bridge that forwards no samples fails."""
ALL_TESTS_S = 1800
"""Time limit of the master, which runs during all tests of this file."""
MIN_SAMPLES = 30
OTHER_TYPE = ("rostopic", "pub", "-r", "10", "/scan", "std_msgs/String", "x")

Process = subprocess.Popen[str]


class Site:
    """A host with ROS 1 and its master, and another host on the same cable.

    Attributes:
        folder: Folder for the home and the temporary files of all programs.
    """

    def __init__(self, hosts: tuple[TestHost, TestHost], folder: Path) -> None:
        self.ros1_host, self.wire_host = hosts
        self.folder = folder
        self.environment = os.environ | {
            "ROS_HOME": str(folder / "ros"),
            "TMPDIR": str(folder),
            "ROS_MASTER_URI": f"http://{self.ros1_host.address}:11311",
            "ROS_IP": self.ros1_host.address,
        }

    @contextmanager
    def run(self, host: TestHost, *argv: str, limit_s: int = LIMIT_S) -> Iterator[Process]:
        """Run a command on a host for the duration of the context."""
        command = ("timeout", "-k", "10", str(limit_s), "nsenter", "-t", str(host.pid), "-n", *argv)
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=self.environment) as process:
            try:
                yield process
            finally:
                process.terminate()
                process.communicate()

    def run_to_end(self, *argv: str) -> subprocess.CompletedProcess[str]:
        """Run a command on the host with ROS 1 until it exits; return its result."""
        with self.run(self.ros1_host, *argv) as process:
            output_text, errors = process.communicate()
        return subprocess.CompletedProcess(argv, process.returncode, output_text, errors)

    def bridge_line(self, middleware_name: str, *words: str) -> tuple[str, ...]:
        line = (
            "bridge",
            "--from",
            "ros1",
            "--to",
            middleware_name,
            "--address",
            self.ros1_host.address,
            "--domain",
            str(DOMAIN),
        )
        return (sys.executable, "-m", "fieldkit", *line, *words)

    @contextmanager
    def bridge(self, middleware_name: str, *words: str) -> Iterator[Process]:
        """Run a bridge for the duration of the context; it is ready when the body starts."""
        with self.run(self.ros1_host, *self.bridge_line(middleware_name, *words)) as process:
            assert process.stderr is not None
            output_text = process.stderr.readline()
            assert output_text.startswith("note: the bridge is up"), output_text + process.stderr.read()
            yield process

    def ros1(self, verb: str) -> AbstractContextManager[Process]:
        """Run a ROS 1 node."""
        return self.run(self.ros1_host, "/usr/bin/python3", str(NODES / "ros1_end.py"), verb)

    def wire(self, verb: str, middleware_name: str, quality: str = "") -> AbstractContextManager[Process]:
        """Run a publisher or subscriber without ROS 1 on the other host."""
        topic = topics.describe(standard_types(), "/scan", TYPE, parse_qos(quality), domain=DOMAIN, node=verb)
        settings = {"listen/endpoints": f'["tcp/{self.wire_host.address}:0"]'} if middleware_name == "zenoh" else {}
        network = {"address": self.wire_host.address, "domain": DOMAIN, "node": verb, "settings": settings}
        samples = self.folder / "samples"
        samples.write_text(
            "\n".join(map(scan, range(FIRST_WIRE_NUMBER, FIRST_WIRE_NUMBER + 50 * LIMIT_S))), encoding="ascii"
        )
        words = (verb, middleware_name, json.dumps(network), json.dumps(topic), str(samples))
        return self.run(self.wire_host, sys.executable, str(NODES / "wire_end.py"), *words)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with two_connected_hosts() as hosts:
        bridge_site = Site(hosts, tmp_path_factory.mktemp("bridge"))
        with bridge_site.run(hosts[0], "rosmaster", "--core", "-p", "11311", limit_s=ALL_TESTS_S):
            # A node that starts before its master would print a warning between the received messages.
            master = f"/dev/tcp/{hosts[0].address}/11311"
            assert bridge_site.run_to_end("bash", "-c", f"until : <{master}; do sleep 0.1; done").returncode == 0
            yield bridge_site


def scan(number: int) -> str:
    """Return a scan in the serialization of rosbags for ROS 2, hexadecimal."""
    kinds = standard_types().ros2.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](number, 5), "base")
    ranges = np.array([number, 0.5], np.float32)
    message = kinds[TYPE](header, 0, 0, 0, 0, 0, 0, 0, ranges, np.array([], np.float32))
    return bytes(standard_types().ros2.serialize_cdr(message, TYPE)).hex()


def receive(subscriber: Process, number_of: Callable[[str], int]) -> list[tuple[int, str]]:
    """Return the received samples with their numbers; stop when enough samples have arrived from both sides."""
    assert subscriber.stdout is not None
    samples: list[tuple[int, str]] = []
    missing = {True: MIN_SAMPLES, False: MIN_SAMPLES}
    for line in subscriber.stdout:
        number = number_of(line)
        samples.append((number, line.strip()))
        missing[number >= FIRST_WIRE_NUMBER] -= 1
        if max(missing.values()) <= 0:
            return samples
    raise AssertionError(f"the subscriber exited: {subscriber.stderr and subscriber.stderr.read()}")


def number_of_cdr(line: str) -> int:
    # The first member is the seconds of the stamp.
    return int.from_bytes(bytes.fromhex(line)[4:8], "little")


def number_of_ros1(line: str) -> int:
    return int(json.loads(line)[0][0])


@pytest.mark.emulated
@pytest.mark.parametrize("middleware_name", ["dds", "zenoh"])
def test_scans_are_forwarded_in_both_directions_once_and_unchanged(site: Site, middleware_name: str) -> None:
    """Both sides publish and subscribe, so a sample in a loop would arrive twice."""
    with (
        site.wire("hear", middleware_name) as wire_subscriber,
        site.ros1("hear") as ros1_subscriber,
        site.bridge(middleware_name, "--both", SCAN, "--json") as running,
        site.ros1("say"),
        site.wire("say", middleware_name),
    ):
        received_by_wire, received_by_ros1 = (
            receive(wire_subscriber, number_of_cdr),
            receive(ros1_subscriber, number_of_ros1),
        )
        running.send_signal(signal.SIGINT)
        output_text, errors = running.communicate()
    assert [line for _, line in received_by_wire] == [scan(number) for number, _ in received_by_wire], (
        "the samples are those that rosbags serializes"
    )
    for number, line in received_by_ros1:
        stamp, frame, ranges = json.loads(line)
        assert (stamp, frame, ranges) == ([number, 5], "base", [number, 0.5])
    for numbers in ([number for number, _ in received_by_wire], [number for number, _ in received_by_ros1]):
        assert len(set(numbers)) == len(numbers), "no sample arrives twice"

    assert (running.returncode, errors) == (0, "")
    report = {(counts["source"], counts["target"]): counts for counts in json.loads(output_text)}
    assert report.keys() == {("ros1", middleware_name), (middleware_name, "ros1")}
    size_bytes = {
        "ros1": len(standard_types().ros2.cdr_to_ros1(bytes.fromhex(scan(1)), TYPE)),
        middleware_name: len(scan(1)) // 2,
    }
    for (source, _), counts in report.items():
        assert counts["messages"] >= MIN_SAMPLES
        assert counts["bytes"] == counts["messages"] * size_bytes[source]
        assert (counts["topic"], counts["type"], counts["refused"], counts["unreadable"]) == ("/scan", TYPE, 0, 0)
        assert 0 < counts["delay_median_s"] <= counts["delay_p99_s"] < LIMIT_S
        assert counts["bytes_per_s"] == pytest.approx(counts["per_s"] * size_bytes[source])


@pytest.mark.emulated
@pytest.mark.parametrize("middleware_name", mark_nightly(["dds", "zenoh"]))
def test_a_late_subscriber_receives_the_latched_message_of_ros_1(site: Site, middleware_name: str) -> None:
    latched = ("rostopic", "pub", "--latch", "/scan", "sensor_msgs/LaserScan", "{header: {frame_id: once}}")
    quality = "transient_local,depth=1"
    with site.bridge(middleware_name, f"{SCAN}:{quality}"), site.run(site.ros1_host, *latched):
        for _ in range(2):  # the second subscriber starts after the message was forwarded
            with site.wire("hear", middleware_name, quality) as subscriber:
                assert subscriber.stdout is not None
                received: Any = standard_types().ros2.deserialize_cdr(
                    bytes.fromhex(subscriber.stdout.readline()), TYPE
                )
                assert received.header.frame_id == "once"


@pytest.mark.emulated
def test_a_stopped_bridge_leaves_no_process_and_no_file(site: Site) -> None:
    with site.bridge("dds", SCAN) as running:
        assert " * /fieldkit_bridge " in site.run_to_end("rostopic", "info", "/scan").stdout
        running.send_signal(signal.SIGTERM)
        output_text, _ = running.communicate()
    assert running.returncode == 0
    assert "/scan" in output_text
    assert "ros1 to dds" in output_text
    assert "/fieldkit_bridge" not in site.run_to_end("rostopic", "info", "/scan").stdout
    assert not list(site.folder.glob("fieldkit-*"))
    assert not list(site.folder.glob("ros/log/*bridge*"))


@pytest.mark.emulated
def test_a_topic_of_another_type_is_reported_and_not_forwarded(site: Site) -> None:
    with site.bridge("dds", SCAN) as running, site.run(site.ros1_host, *OTHER_TYPE):
        assert running.stderr is not None
        late_message = running.stderr.readline()
        second_bridge = site.run_to_end(*site.bridge_line("dds", "--node", "second", SCAN))
    sentence = "error: /scan is of type std_msgs/String in ros1, not sensor_msgs/msg/LaserScan\n"
    assert late_message == sentence
    assert (second_bridge.returncode, second_bridge.stderr.startswith(sentence)) == (2, True)


@pytest.mark.emulated
def test_a_missing_master_is_reported(site: Site) -> None:
    completed = site.run_to_end(*site.bridge_line("dds", "--master", "127.0.0.1:9", SCAN))
    assert completed.returncode == 3
    assert completed.stderr.startswith(
        "error: the bridge does not start: no ROS master answers at http://127.0.0.1:9\n"
    )
    assert "roscore" in completed.stderr


@pytest.mark.parametrize("middleware_name", ["dds", "zenoh"])
def test_a_topic_of_another_type_is_detected_without_a_master(middleware_name: str) -> None:
    def describe(kind: str) -> Topic:
        report = topics.describe(standard_types(), "/t", kind, PROFILES["default"], domain=DOMAIN, node="n")
        return Topic.from_json(report)

    settings = {"listen/endpoints": '["tcp/127.0.0.1:0"]'} if middleware_name == "zenoh" else {}
    network = Network("127.0.0.1", discovery="peers", domain=DOMAIN, settings=settings)
    running = middleware.adapter(middleware_name)(network)
    publisher = running.publisher(describe("std_msgs/String"))
    assert running.other_types(describe(TYPE)) == {"std_msgs::msg::dds_::String_"}
    assert running.other_types(describe("std_msgs/String")) == set()
    assert publisher.matched() == 0
    running.close()


class FakeMiddleware:
    """A middleware through which a test sends and receives samples."""

    version = "recorded"

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.accepts = True
        self.deliver: Deliver | None = None

    def publisher(self, _: Topic) -> "FakeMiddleware":
        return self

    def subscribe(self, _: Topic, deliver: Deliver) -> Callable[[], int]:
        self.deliver = deliver
        return lambda: 1

    def write(self, data: bytes) -> bool:
        if self.accepts:
            self.written.append(data)
        return self.accepts

    def matched(self) -> int:
        return 1

    def drain(self, limit_s: float) -> None:
        """Do nothing."""

    def other_types(self, _: Topic) -> set[str]:
        return set()

    def close(self) -> None:
        """Do nothing."""


def test_invalid_messages_are_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = FakeMiddleware(), FakeMiddleware()
    monkeypatch.setattr(
        "fieldkit.agent.messaging.middleware.adapter", lambda over: lambda _: source if over == "ros1" else target
    )
    network = Network("127.0.0.1")
    sample = bytes.fromhex(scan(7))
    ros1_sample = bytes(standard_types().ros2.cdr_to_ros1(sample, TYPE))
    crossing = Crossing.parse(SCAN)
    with bridge.bridge_topics(Side("ros1", network), Side("dds", network), [crossing], standard_types()) as (
        carrier,
    ):
        assert source.deliver is not None
        for data in (b"", ros1_sample[:-1], ros1_sample + b"x", b"\xff" * 200, ros1_sample):
            source.deliver(data, time.time_ns())
        target.accepts = False
        source.deliver(ros1_sample, time.time_ns())
        target.accepts = True
    source.deliver(ros1_sample, time.time_ns())  # the bridge has been stopped
    report = carrier.counts()
    assert target.written == [sample]
    assert (report.messages, report.unreadable, report.refused) == (1, 4, 1)
    assert report.bytes == len(ros1_sample)


@pytest.mark.parametrize(
    ("words", "output_text"),
    [
        (("--from", "ros1", "--to", "dds"), "no topic is given"),
        (("--from", "ros1", "--to", "dds", "/scan"), "'/scan' is not a topic with its type"),
        (("--from", "ros1", "--to", "dds", "/scan:sensor_msgs/LasrScan"), "there is no message type"),
        (("--from", "ros1", "--to", "dds", "/marker:visualization_msgs/Marker"), "differs between ROS 1 and ROS 2"),
        (("--from", "zenoh", "--to", "dds", "/t:std_msgs/Time"), "differs between ROS 1 and ROS 2"),
        (("--from", "ros1", "--to", "dds", f"{SCAN}:sensor"), "'sensor' is not a quality of service"),
        (("--from", "ros1", "--to", "dds", SCAN, "--both", SCAN), "/scan is named twice"),
        (("--from", "dds", "--to", "dds", SCAN), "a bridge cannot connect dds with dds"),
        (("--from", "ros2", "--to", "dds", SCAN), "cannot be 'ros2'"),
        (("--from", "ros1", "--to", "dds", SCAN, "--address", "robot"), "'robot' is not an IPv4 address"),
        (("--from", "ros1", "--to", "dds", SCAN, "--master", "http://robot"), "is not a host and port"),
        (("--from", "ros1", "--to", "dds", SCAN, "--domain", "230"), "230 is not a domain of ROS 2"),
        (("--from", "ros1", "--to", "dds", SCAN, "--node", "a b"), "'a b' is not a valid node name"),
        (("--from", "ros1", "--to", "dds", SCAN, "--type", "Radio"), "'Radio' is not a message type and its file"),
        (
            ("--from", "ros1", "--to", "dds", SCAN, "--type", "lab_msgs/Radio=no.msg"),
            "no.msg: cannot be read",
        ),
    ],
)
def test_invalid_arguments_are_reported_before_the_bridge_starts(
    words: Sequence[str], output_text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bridge", *words]) == 2
    assert output_text in capsys.readouterr().err.replace("\n", " ")


def test_the_command_line_accepts_all_middlewares() -> None:
    assert {*MIDDLEWARES, "ros2"} == set(ADAPTERS)
