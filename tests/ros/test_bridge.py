"""`fieldkit bridge` between a real ROS 1 on one host and DDS or Zenoh on another."""

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
from fieldkit.agent import middleware
from fieldkit.agent.middleware import ADAPTERS, Deliver, Network, Topic
from fieldkit.cli.commands.bridge import MIDDLEWARES
from fieldkit.ros import bridge, topics
from fieldkit.ros.bridge import Side
from fieldkit.ros.crossings import Crossing, parse_qos
from fieldkit.ros.qos import PROFILES
from fieldkit.ros.types import shipped
from tests.helpers.two_hosts import TestHost, cabled

TYPE = "sensor_msgs/msg/LaserScan"
SCAN = "/scan:sensor_msgs/LaserScan"
DOMAIN = 5
FOREIGN = 1000
"""Numbers of scans from there on are from the side that has no ROS 1."""
ENDS = Path(__file__).parent
LIMIT_S = 90
"""No end runs longer: a bridge that brings nothing fails its test by then."""
ENOUGH = 30
OTHER_TYPE = ("rostopic", "pub", "-r", "10", "/scan", "std_msgs/String", "x")

Process = subprocess.Popen[str]


class Site:
    """ROS 1 on one host, its master included, and another host on the same cable.

    Attributes:
        folder: Home and temporary files of all that runs there.
    """

    def __init__(self, hosts: tuple[TestHost, TestHost], folder: Path) -> None:
        self.near, self.far = hosts
        self.folder = folder
        self.environment = os.environ | {
            "ROS_HOME": str(folder / "ros"),
            "TMPDIR": str(folder),
            "ROS_MASTER_URI": f"http://{self.near.address}:11311",
            "ROS_IP": self.near.address,
        }

    @contextmanager
    def started(self, host: TestHost, *argv: str) -> Iterator[Process]:
        """Run a command on a host while the body runs."""
        command = ("timeout", "-k", "10", str(LIMIT_S), "nsenter", "-t", str(host.pid), "-n", *argv)
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=self.environment) as process:
            try:
                yield process
            finally:
                process.terminate()
                process.communicate()

    def asked(self, *argv: str) -> subprocess.CompletedProcess[str]:
        """Run a command on the host with ROS 1 to its end."""
        with self.started(self.near, *argv) as process:
            said, errors = process.communicate()
        return subprocess.CompletedProcess(argv, process.returncode, said, errors)

    def bridge_line(self, over: str, *words: str) -> tuple[str, ...]:
        line = ("bridge", "--from", "ros1", "--to", over, "--address", self.near.address, "--domain", str(DOMAIN))
        return (sys.executable, "-m", "fieldkit", *line, *words)

    @contextmanager
    def bridge(self, over: str, *words: str) -> Iterator[Process]:
        """Run a bridge while the body runs; it is up when that begins."""
        with self.started(self.near, *self.bridge_line(over, *words)) as process:
            assert process.stderr is not None
            said = process.stderr.readline()
            assert said.startswith("note: the bridge is up"), said + process.stderr.read()
            yield process

    def ros1(self, verb: str) -> AbstractContextManager[Process]:
        """Run a node of ROS 1."""
        return self.started(self.near, "/usr/bin/python3", str(ENDS / "ros1_end.py"), verb)

    def wire(self, verb: str, over: str, quality: str = "") -> AbstractContextManager[Process]:
        """Run an end that has no ROS 1 on the other host."""
        topic = topics.describe(shipped(), "/scan", TYPE, parse_qos(quality), domain=DOMAIN, node=verb)
        settings = {"listen/endpoints": f'["tcp/{self.far.address}:0"]'} if over == "zenoh" else {}
        network = {"address": self.far.address, "domain": DOMAIN, "node": verb, "settings": settings}
        samples = self.folder / "samples"
        samples.write_text("\n".join(map(scan, range(FOREIGN, FOREIGN + 50 * LIMIT_S))), encoding="ascii")
        words = (verb, over, json.dumps(network), json.dumps(topic), str(samples))
        return self.started(self.far, sys.executable, str(ENDS / "wire_end.py"), *words)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with cabled() as hosts:
        found = Site(hosts, tmp_path_factory.mktemp("bridge"))
        with found.started(hosts[0], "rosmaster", "--core", "-p", "11311"):
            # A node that is faster than its master prints a warning among the messages that it hears.
            master = f"/dev/tcp/{hosts[0].address}/11311"
            assert found.asked("bash", "-c", f"until : <{master}; do sleep 0.1; done").returncode == 0
            yield found


def scan(number: int) -> str:
    """Return a scan as rosbags serializes it for ROS 2, hexadecimal."""
    kinds = shipped().ros2.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](number, 5), "base")
    ranges = np.array([number, 0.5], np.float32)
    made = kinds[TYPE](header, 0, 0, 0, 0, 0, 0, 0, ranges, np.array([], np.float32))
    return bytes(shipped().ros2.serialize_cdr(made, TYPE)).hex()


def heard(ears: Process, number_of: Callable[[str], int]) -> list[tuple[int, str]]:
    """Return what an end hears by its number, until it has heard enough of both sides."""
    assert ears.stdout is not None
    found: list[tuple[int, str]] = []
    missing = {True: ENOUGH, False: ENOUGH}
    for line in ears.stdout:
        number = number_of(line)
        found.append((number, line.strip()))
        missing[number >= FOREIGN] -= 1
        if max(missing.values()) <= 0:
            return found
    raise AssertionError(f"it ended: {ears.stderr and ears.stderr.read()}")


def number_of_cdr(line: str) -> int:
    # The seconds of the stamp are the first member.
    return int.from_bytes(bytes.fromhex(line)[4:8], "little")


def number_of_ros1(line: str) -> int:
    return int(json.loads(line)[0][0])


@pytest.mark.emulated
@pytest.mark.parametrize("over", ["dds", "zenoh"])
def test_scans_cross_both_ways_once_and_whole(site: Site, over: str) -> None:
    """Both ends speak and hear: what a bridge sent back would come twice to the side that it is from."""
    with (
        site.wire("hear", over) as wire_ears,
        site.ros1("hear") as ros1_ears,
        site.bridge(over, "--both", SCAN, "--json") as running,
        site.ros1("say"),
        site.wire("say", over),
    ):
        by_wire, by_ros1 = heard(wire_ears, number_of_cdr), heard(ros1_ears, number_of_ros1)
        running.send_signal(signal.SIGINT)
        said, errors = running.communicate()
    assert [line for _, line in by_wire] == [scan(number) for number, _ in by_wire], "as rosbags writes them"
    for number, line in by_ros1:
        stamp, frame, ranges = json.loads(line)
        assert (stamp, frame, ranges) == ([number, 5], "base", [number, 0.5])
    for numbers in ([number for number, _ in by_wire], [number for number, _ in by_ros1]):
        assert len(set(numbers)) == len(numbers), "none comes twice"

    assert (running.returncode, errors) == (0, "")
    told = {(one["source"], one["target"]): one for one in json.loads(said)}
    assert told.keys() == {("ros1", over), (over, "ros1")}
    size_bytes = {"ros1": len(shipped().ros2.cdr_to_ros1(bytes.fromhex(scan(1)), TYPE)), over: len(scan(1)) // 2}
    for (source, _), one in told.items():
        assert one["messages"] >= ENOUGH
        assert one["bytes"] == one["messages"] * size_bytes[source]
        assert (one["topic"], one["type"], one["refused"], one["unreadable"]) == ("/scan", TYPE, 0, 0)
        assert 0 < one["delay_median_s"] <= one["delay_p99_s"] < LIMIT_S
        assert one["bytes_per_s"] == pytest.approx(one["per_s"] * size_bytes[source])


@pytest.mark.emulated
@pytest.mark.parametrize("over", ["dds", "zenoh"])
def test_who_comes_late_gets_what_ros_1_has_latched(site: Site, over: str) -> None:
    latched = ("rostopic", "pub", "--latch", "/scan", "sensor_msgs/LaserScan", "{header: {frame_id: once}}")
    late = "transient_local,depth=1"
    with site.bridge(over, f"{SCAN}:{late}"), site.started(site.near, *latched):
        for _ in range(2):  # the second comes when it has been carried for sure
            with site.wire("hear", over, late) as ears:
                assert ears.stdout is not None
                heard: Any = shipped().ros2.deserialize_cdr(bytes.fromhex(ears.stdout.readline()), TYPE)
                assert heard.header.frame_id == "once"


@pytest.mark.emulated
def test_a_bridge_that_ends_leaves_nothing(site: Site) -> None:
    with site.bridge("dds", SCAN) as running:
        assert " * /fieldkit_bridge " in site.asked("rostopic", "info", "/scan").stdout
        running.send_signal(signal.SIGTERM)
        said, _ = running.communicate()
    assert running.returncode == 0
    assert "/scan" in said
    assert "ros1 to dds" in said
    assert "/fieldkit_bridge" not in site.asked("rostopic", "info", "/scan").stdout
    assert not list(site.folder.glob("fieldkit-*"))
    assert not list(site.folder.glob("ros/log/*bridge*"))


@pytest.mark.emulated
def test_a_topic_of_another_type_is_told_and_not_carried(site: Site) -> None:
    with site.bridge("dds", SCAN) as running, site.started(site.near, *OTHER_TYPE):
        assert running.stderr is not None
        late = running.stderr.readline()
        at_once = site.asked(*site.bridge_line("dds", "--node", "second", SCAN))
    sentence = "error: /scan is of type std_msgs/String in ros1, not sensor_msgs/msg/LaserScan\n"
    assert late == sentence
    assert (at_once.returncode, at_once.stderr.startswith(sentence)) == (2, True)


@pytest.mark.emulated
def test_no_master_is_told(site: Site) -> None:
    done = site.asked(*site.bridge_line("dds", "--master", "127.0.0.1:9", SCAN))
    assert done.returncode == 3
    assert done.stderr.startswith("error: the bridge does not start: no ROS master answers at http://127.0.0.1:9\n")
    assert "roscore" in done.stderr


@pytest.mark.parametrize("over", ["dds", "zenoh"])
def test_a_topic_of_another_type_is_known_without_a_master(over: str) -> None:
    def described(kind: str) -> Topic:
        told = topics.describe(shipped(), "/t", kind, PROFILES["default"], domain=DOMAIN, node="n")
        return Topic.from_json(told)

    settings = {"listen/endpoints": '["tcp/127.0.0.1:0"]'} if over == "zenoh" else {}
    network = Network("127.0.0.1", discovery="peers", domain=DOMAIN, settings=settings)
    running = middleware.adapter(over)(network)
    publisher = running.publisher(described("std_msgs/String"))
    assert running.other_types(described(TYPE)) == {"std_msgs::msg::dds_::String_"}
    assert running.other_types(described("std_msgs/String")) == set()
    assert publisher.matched() == 0
    running.close()


class Recorded:
    """A middleware of which a test is both ends."""

    version = "recorded"

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.takes = True
        self.deliver: Deliver | None = None

    def publisher(self, _: Topic) -> "Recorded":
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
        """Nothing waits."""

    def other_types(self, _: Topic) -> set[str]:
        return set()

    def close(self) -> None:
        """Nothing runs."""


def test_what_is_no_message_is_dropped_and_counted_and_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = Recorded(), Recorded()
    monkeypatch.setattr(
        "fieldkit.agent.middleware.adapter", lambda over: lambda _: source if over == "ros1" else target
    )
    network = Network("127.0.0.1")
    sample = bytes.fromhex(scan(7))
    of_ros1 = bytes(shipped().ros2.cdr_to_ros1(sample, TYPE))
    crossing = Crossing.parse(SCAN)
    with bridge.bridged(Side("ros1", network), Side("dds", network), [crossing], shipped()) as (carrier,):
        assert source.deliver is not None
        for data in (b"", of_ros1[:-1], of_ros1 + b"x", b"\xff" * 200, of_ros1):
            source.deliver(data, time.time_ns())
        target.takes = False
        source.deliver(of_ros1, time.time_ns())
        target.takes = True
    source.deliver(of_ros1, time.time_ns())  # after its end
    told = carrier.told()
    assert target.written == [sample]
    assert (told.messages, told.unreadable, told.refused) == (1, 4, 1)
    assert told.bytes == len(of_ros1)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--from", "ros1", "--to", "dds"), "no topic is named"),
        (("--from", "ros1", "--to", "dds", "/scan"), "'/scan' is not a topic with its type"),
        (("--from", "ros1", "--to", "dds", "/scan:sensor_msgs/LasrScan"), "there is no message type"),
        (("--from", "ros1", "--to", "dds", "/marker:visualization_msgs/Marker"), "differs between ROS 1 and ROS 2"),
        (("--from", "zenoh", "--to", "dds", "/t:std_msgs/Time"), "differs between ROS 1 and ROS 2"),
        (("--from", "ros1", "--to", "dds", f"{SCAN}:sensor"), "'sensor' is not a quality of service"),
        (("--from", "ros1", "--to", "dds", SCAN, "--both", SCAN), "/scan is named twice"),
        (("--from", "dds", "--to", "dds", SCAN), "a bridge cannot connect dds with dds"),
        (("--from", "ros2", "--to", "dds", SCAN), "cannot be 'ros2'"),
        (("--from", "ros1", "--to", "dds", SCAN, "--address", "robot"), "'robot' is no IPv4 address"),
        (("--from", "ros1", "--to", "dds", SCAN, "--master", "http://robot"), "is no host and port"),
        (("--from", "ros1", "--to", "dds", SCAN, "--domain", "230"), "230 is no domain of ROS 2"),
        (("--from", "ros1", "--to", "dds", SCAN, "--node", "a b"), "'a b' is no name of a node"),
        (("--from", "ros1", "--to", "dds", SCAN, "--type", "Radio"), "'Radio' is no type and its file"),
        (
            ("--from", "ros1", "--to", "dds", SCAN, "--type", "lab_msgs/Radio=no.msg"),
            "no.msg: cannot be read",
        ),
    ],
)
def test_what_cannot_be_bridged_is_told_before_anything_starts(
    words: Sequence[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bridge", *words]) == 2
    assert said in capsys.readouterr().err.replace("\n", " ")


def test_the_command_line_names_every_middleware() -> None:
    assert {*MIDDLEWARES, "ros2"} == set(ADAPTERS)
