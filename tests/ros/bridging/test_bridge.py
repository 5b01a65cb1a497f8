"""`fieldkit bridge` between a real ROS 1 on one host, and DDS or Zenoh on another."""

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
FOREIGN = 1000
"""First number of the scans from the side without ROS 1."""
ENDS = Path(__file__).parent
LIMIT_S = 90
ALL_TESTS_S = 1800
"""The master runs during all tests of this file."""
"""Time limit of all nodes: a bridge that forwards nothing fails its test by then."""
ENOUGH = 30
OTHER_TYPE = ("rostopic", "pub", "-r", "10", "/scan", "std_msgs/String", "x")

Process = subprocess.Popen[str]


class Site:
    """ROS 1 with its master on one host, and another host on the same cable.

    Attributes:
        folder: Home and temporary files of all programs.
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
    def started(self, host: TestHost, *argv: str, limit_s: int = LIMIT_S) -> Iterator[Process]:
        """Run a command on a host while the body runs."""
        command = ("timeout", "-k", "10", str(limit_s), "nsenter", "-t", str(host.pid), "-n", *argv)
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=self.environment) as process:
            try:
                yield process
            finally:
                process.terminate()
                process.communicate()

    def completed(self, *argv: str) -> subprocess.CompletedProcess[str]:
        """Run a command on the host with ROS 1, and return its result."""
        with self.started(self.ros1_host, *argv) as process:
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
        """Run a bridge while the body runs; it is ready when the body starts."""
        with self.started(self.ros1_host, *self.bridge_line(middleware_name, *words)) as process:
            assert process.stderr is not None
            output_text = process.stderr.readline()
            assert output_text.startswith("note: the bridge is up"), output_text + process.stderr.read()
            yield process

    def ros1(self, verb: str) -> AbstractContextManager[Process]:
        """Run a ROS 1 node."""
        return self.started(self.ros1_host, "/usr/bin/python3", str(ENDS / "ros1_end.py"), verb)

    def wire(self, verb: str, middleware_name: str, quality: str = "") -> AbstractContextManager[Process]:
        """Run a publisher or subscriber without ROS 1 on the other host."""
        topic = topics.describe(standard_types(), "/scan", TYPE, parse_qos(quality), domain=DOMAIN, node=verb)
        settings = {"listen/endpoints": f'["tcp/{self.wire_host.address}:0"]'} if middleware_name == "zenoh" else {}
        network = {"address": self.wire_host.address, "domain": DOMAIN, "node": verb, "settings": settings}
        samples = self.folder / "samples"
        samples.write_text("\n".join(map(scan, range(FOREIGN, FOREIGN + 50 * LIMIT_S))), encoding="ascii")
        words = (verb, middleware_name, json.dumps(network), json.dumps(topic), str(samples))
        return self.started(self.wire_host, sys.executable, str(ENDS / "wire_end.py"), *words)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with two_connected_hosts() as hosts:
        samples = Site(hosts, tmp_path_factory.mktemp("bridge"))
        with samples.started(hosts[0], "rosmaster", "--core", "-p", "11311", limit_s=ALL_TESTS_S):
            # A node that starts before its master prints a warning among the received messages.
            master = f"/dev/tcp/{hosts[0].address}/11311"
            assert samples.completed("bash", "-c", f"until : <{master}; do sleep 0.1; done").returncode == 0
            yield samples


def scan(number: int) -> str:
    """Return a scan in the serialization of rosbags for ROS 2, hexadecimal."""
    kinds = standard_types().ros2.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](number, 5), "base")
    ranges = np.array([number, 0.5], np.float32)
    message = kinds[TYPE](header, 0, 0, 0, 0, 0, 0, 0, ranges, np.array([], np.float32))
    return bytes(standard_types().ros2.serialize_cdr(message, TYPE)).hex()


def received(subscriber: Process, number_of: Callable[[str], int]) -> list[tuple[int, str]]:
    """Return the received samples with their numbers, until enough have arrived from both sides."""
    assert subscriber.stdout is not None
    samples: list[tuple[int, str]] = []
    missing = {True: ENOUGH, False: ENOUGH}
    for line in subscriber.stdout:
        number = number_of(line)
        samples.append((number, line.strip()))
        missing[number >= FOREIGN] -= 1
        if max(missing.values()) <= 0:
            return samples
    raise AssertionError(f"it ended: {subscriber.stderr and subscriber.stderr.read()}")


def number_of_cdr(line: str) -> int:
    # The first member is the seconds of the stamp.
    return int.from_bytes(bytes.fromhex(line)[4:8], "little")


def number_of_ros1(line: str) -> int:
    return int(json.loads(line)[0][0])


@pytest.mark.emulated
@pytest.mark.parametrize("middleware_name", ["dds", "zenoh"])
def test_scans_are_forwarded_both_ways_once_and_unchanged(site: Site, middleware_name: str) -> None:
    """Both sides publish and subscribe: a sample that loops would arrive twice."""
    with (
        site.wire("hear", middleware_name) as wire_subscriber,
        site.ros1("hear") as ros1_subscriber,
        site.bridge(middleware_name, "--both", SCAN, "--json") as running,
        site.ros1("say"),
        site.wire("say", middleware_name),
    ):
        received_by_wire, received_by_ros1 = (
            received(wire_subscriber, number_of_cdr),
            received(ros1_subscriber, number_of_ros1),
        )
        running.send_signal(signal.SIGINT)
        output_text, errors = running.communicate()
    assert [line for _, line in received_by_wire] == [scan(number) for number, _ in received_by_wire], (
        "as serialized by rosbags"
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
        assert counts["messages"] >= ENOUGH
        assert counts["bytes"] == counts["messages"] * size_bytes[source]
        assert (counts["topic"], counts["type"], counts["refused"], counts["unreadable"]) == ("/scan", TYPE, 0, 0)
        assert 0 < counts["delay_median_s"] <= counts["delay_p99_s"] < LIMIT_S
        assert counts["bytes_per_s"] == pytest.approx(counts["per_s"] * size_bytes[source])


@pytest.mark.emulated
@pytest.mark.parametrize("middleware_name", mark_nightly(["dds", "zenoh"]))
def test_late_subscriber_receives_the_latched_message_of_ros_1(site: Site, middleware_name: str) -> None:
    latched = ("rostopic", "pub", "--latch", "/scan", "sensor_msgs/LaserScan", "{header: {frame_id: once}}")
    late = "transient_local,depth=1"
    with site.bridge(middleware_name, f"{SCAN}:{late}"), site.started(site.ros1_host, *latched):
        for _ in range(2):  # the second subscriber starts after the message was forwarded
            with site.wire("hear", middleware_name, late) as subscriber:
                assert subscriber.stdout is not None
                received: Any = standard_types().ros2.deserialize_cdr(
                    bytes.fromhex(subscriber.stdout.readline()), TYPE
                )
                assert received.header.frame_id == "once"


@pytest.mark.emulated
def test_stopped_bridge_leaves_no_process_and_file(site: Site) -> None:
    with site.bridge("dds", SCAN) as running:
        assert " * /fieldkit_bridge " in site.completed("rostopic", "info", "/scan").stdout
        running.send_signal(signal.SIGTERM)
        output_text, _ = running.communicate()
    assert running.returncode == 0
    assert "/scan" in output_text
    assert "ros1 to dds" in output_text
    assert "/fieldkit_bridge" not in site.completed("rostopic", "info", "/scan").stdout
    assert not list(site.folder.glob("fieldkit-*"))
    assert not list(site.folder.glob("ros/log/*bridge*"))


@pytest.mark.emulated
def test_topic_of_another_type_is_reported_and_not_forwarded(site: Site) -> None:
    with site.bridge("dds", SCAN) as running, site.started(site.ros1_host, *OTHER_TYPE):
        assert running.stderr is not None
        late = running.stderr.readline()
        at_once = site.completed(*site.bridge_line("dds", "--node", "second", SCAN))
    sentence = "error: /scan is of type std_msgs/String in ros1, not sensor_msgs/msg/LaserScan\n"
    assert late == sentence
    assert (at_once.returncode, at_once.stderr.startswith(sentence)) == (2, True)


@pytest.mark.emulated
def test_missing_master_is_reported(site: Site) -> None:
    done = site.completed(*site.bridge_line("dds", "--master", "127.0.0.1:9", SCAN))
    assert done.returncode == 3
    assert done.stderr.startswith("error: the bridge does not start: no ROS master answers at http://127.0.0.1:9\n")
    assert "roscore" in done.stderr


@pytest.mark.parametrize("middleware_name", ["dds", "zenoh"])
def test_topic_of_another_type_is_detected_without_a_master(middleware_name: str) -> None:
    def described(kind: str) -> Topic:
        report = topics.describe(standard_types(), "/t", kind, PROFILES["default"], domain=DOMAIN, node="n")
        return Topic.from_json(report)

    settings = {"listen/endpoints": '["tcp/127.0.0.1:0"]'} if middleware_name == "zenoh" else {}
    network = Network("127.0.0.1", discovery="peers", domain=DOMAIN, settings=settings)
    running = middleware.adapter(middleware_name)(network)
    publisher = running.publisher(described("std_msgs/String"))
    assert running.other_types(described(TYPE)) == {"std_msgs::msg::dds_::String_"}
    assert running.other_types(described("std_msgs/String")) == set()
    assert publisher.matched() == 0
    running.close()


class FakeMiddleware:
    """A middleware whose other side is the test."""

    version = "recorded"

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.takes = True
        self.deliver: Deliver | None = None

    def publisher(self, _: Topic) -> "FakeMiddleware":
        return self

    def subscribe(self, _: Topic, deliver: Deliver) -> Callable[[], int]:
        self.deliver = deliver
        return lambda: 1

    def write(self, data: bytes) -> bool:
        if self.takes:
            self.written.append(data)
        return self.takes

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
    of_ros1 = bytes(standard_types().ros2.cdr_to_ros1(sample, TYPE))
    crossing = Crossing.parse(SCAN)
    with bridge.bridge_topics(Side("ros1", network), Side("dds", network), [crossing], standard_types()) as (
        carrier,
    ):
        assert source.deliver is not None
        for data in (b"", of_ros1[:-1], of_ros1 + b"x", b"\xff" * 200, of_ros1):
            source.deliver(data, time.time_ns())
        target.takes = False
        source.deliver(of_ros1, time.time_ns())
        target.takes = True
    source.deliver(of_ros1, time.time_ns())  # after the carrier was stopped
    report = carrier.counts()
    assert target.written == [sample]
    assert (report.messages, report.unreadable, report.refused) == (1, 4, 1)
    assert report.bytes == len(of_ros1)


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
def test_invalid_arguments_are_reported_before_anything_starts(
    words: Sequence[str], output_text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bridge", *words]) == 2
    assert output_text in capsys.readouterr().err.replace("\n", " ")


def test_command_line_accepts_all_middlewares() -> None:
    assert {*MIDDLEWARES, "ros2"} == set(ADAPTERS)
