"""The agent as it runs on robots: a single file on two hosts with a cable, over each middleware."""

import ast
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from fieldkit.agent.messaging import records
from fieldkit.core.deadline import Deadline
from fieldkit.remote import agent
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from tests.helpers import topic_logs
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until
from tests.helpers.two_hosts import TestHost, two_connected_hosts

TYPE = "std_msgs/msg/UInt8MultiArray"
SAMPLES = 40
STREAM = {"size_bytes": 200, "rate_hz": 100.0, "duration_s": SAMPLES / 100.0, "patience_s": 30.0}
MODULES = sorted((ROOT / "fieldkit" / "agent").glob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_module_requires_only_python_3_8_and_its_middleware(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 8))
    names = {row.module or "" for row in ast.walk(tree) if isinstance(row, ast.ImportFrom)}
    names |= {alias.name for row in ast.walk(tree) if isinstance(row, ast.Import) for alias in row.names}
    packages_by_file = {
        "dds.py": {"cyclonedds"},
        "zenoh.py": {"zenoh"},
        "ros1.py": {"rospy", "rosgraph"},
        "ros2.py": {"rclpy"},
    }
    expected = packages_by_file.get(path.name, set())
    for name in names:
        root = name.split(".")[0]
        assert name.startswith("fieldkit.agent") or root in sys.stdlib_module_names | expected, name


def test_same_modules_give_the_same_file() -> None:
    first = agent.content()
    agent.content.cache_clear()
    assert agent.content() == first


@dataclass(frozen=True)
class Cable:
    """Two hosts, and the file of the agent."""

    hosts: tuple[TestHost, TestHost]
    program: Path

    def arguments(self, middleware_name: str, host: TestHost, **network: object) -> dict[str, Any]:
        """Return the arguments of the agent; the middleware keeps all samples for a subscriber that pauses."""
        node = f"fieldkit_{host.pid}"
        quality = replace(PROFILES["default"], depth=1000)
        topic = topics.describe(standard_types(), "/stream", TYPE, quality, domain=3, node=node)
        network_arguments = {"address": host.address, "domain": 3, "node": node, **network}
        return {"network": network_arguments, "topic": topic, "stream": {"over": middleware_name, **STREAM}}

    @contextmanager
    def running(
        self, host: TestHost, verb: str, arguments: dict[str, Any], *additional_arguments: str
    ) -> Iterator[subprocess.Popen[bytes]]:
        """Run the agent on a host; it is ready when the body starts, and is stopped after it."""
        with host.start(
            (sys.executable, str(self.program), verb, json.dumps(arguments), *additional_arguments)
        ) as process:
            assert process.stderr is not None
            output_text = process.stderr.readline()
            assert output_text.startswith(b"up, "), output_text + process.stderr.read()
            try:
                yield process
            finally:
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=30)


@pytest.fixture(scope="module")
def cable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cable]:
    program = tmp_path_factory.mktemp("agent") / "agent.pyz"
    program.write_bytes(agent.content())
    with two_connected_hosts() as hosts:
        yield Cable(hosts, program)


def check_exchange(cable: Cable, tmp_path: Path, middleware_name: str, **network: object) -> None:
    """Stream from one host to the other, and check that all samples arrive unchanged."""
    first_host, second_host = cable.hosts
    sent_log, received_log = tmp_path / "sent", tmp_path / "received"
    subscriber_arguments = cable.arguments(middleware_name, second_host, peers=(first_host.address,), **network)
    with cable.running(second_host, "subscribe", subscriber_arguments, str(received_log)) as subscriber:
        publisher_arguments = cable.arguments(middleware_name, first_host, peers=(second_host.address,), **network)
        with cable.running(first_host, "publish", publisher_arguments, str(sent_log)) as publisher:
            assert publisher.wait(timeout=60) == 0
    assert subscriber.returncode == 0
    sent_rows, received_rows = topic_logs.rows(sent_log), topic_logs.rows(received_log)
    kinds = [row[0] for row in sent_rows if row[0] != records.SKIPPED]
    assert kinds[:3] == [records.WRITER, records.DISCOVERY_STARTED, records.MATCHED]
    expected = [row[2:5] for row in sent_rows if row[0] == records.SAMPLE]
    assert expected
    assert [row[2:5] for row in received_rows if row[0] == records.SAMPLE] == expected
    kind, _, _, count, checked, _ = received_rows[-1]
    assert (kind, count, checked) == (records.END, len(expected), records.CHECKED)


@pytest.mark.emulated
@pytest.mark.parametrize("discovery", ["multicast", "peers"])
@pytest.mark.parametrize("middleware_name", ["dds", "zenoh"])
def test_samples_arrive_without_a_master(cable: Cable, tmp_path: Path, middleware_name: str, discovery: str) -> None:
    check_exchange(cable, tmp_path, middleware_name, discovery=discovery)


@pytest.mark.emulated
def test_samples_arrive_over_udp(cable: Cable, tmp_path: Path) -> None:
    check_exchange(cable, tmp_path, "zenoh", discovery="peers", transport="udp")


@pytest.mark.emulated
def test_samples_arrive_through_a_router(cable: Cable, tmp_path: Path) -> None:
    first_host, _ = cable.hosts
    route_arguments = {
        "network": {"address": first_host.address, "discovery": "router", "server": first_host.address}
    }
    with cable.running(first_host, "route", route_arguments):
        check_exchange(cable, tmp_path, "zenoh", discovery="router", server=first_host.address)


@pytest.mark.emulated
def test_samples_arrive_with_a_ros_1_master(cable: Cable, tmp_path: Path) -> None:
    first_host, _ = cable.hosts
    with ExitStack() as stack:
        master = stack.enter_context(first_host.start(("rosmaster", "--core", "-p", "11311")))
        stack.callback(master.terminate)
        check_exchange(cable, tmp_path, "ros1", discovery="master", server=first_host.address)


@pytest.mark.emulated
def test_killed_subscriber_leaves_received_samples(cable: Cable, tmp_path: Path) -> None:
    first_host, second_host = cable.hosts
    sent_log, received_log = tmp_path / "sent", tmp_path / "received"
    with cable.running(
        second_host, "subscribe", cable.arguments("dds", second_host), str(received_log)
    ) as subscriber:
        with cable.running(first_host, "publish", cable.arguments("dds", first_host), str(sent_log)) as publisher:
            assert publisher.wait(timeout=60) == 0
        wait_until(lambda: sequences(received_log) == sequences(sent_log), Deadline.after(60))
        subscriber.kill()
    assert sequences(received_log) == sequences(sent_log)
    assert topic_logs.rows(received_log)[-1][0] == records.SAMPLE


@pytest.mark.emulated
def test_publisher_stops_without_acknowledgements(cable: Cable, tmp_path: Path) -> None:
    first_host, second_host = cable.hosts
    sent_log, received_log = tmp_path / "sent", tmp_path / "received"
    with cable.running(
        second_host, "subscribe", cable.arguments("dds", second_host), str(received_log)
    ) as subscriber:
        publisher_arguments = cable.arguments("dds", first_host)
        # The subscriber is suspended before it has received all samples.
        publisher_arguments["stream"]["duration_s"] = 3.0
        with cable.running(first_host, "publish", publisher_arguments, str(sent_log)) as publisher:
            wait_until(lambda: any(row[0] == records.SAMPLE for row in topic_logs.rows(sent_log)), Deadline.after(60))
            subscriber.send_signal(signal.SIGSTOP)
            try:
                _, output_text = publisher.communicate(timeout=60)
            finally:
                subscriber.send_signal(signal.SIGCONT)
            assert publisher.returncode == 0, output_text
    assert topic_logs.rows(sent_log)[-1][0] == records.END


@pytest.mark.emulated
def test_missing_master_is_reported(cable: Cable, tmp_path: Path) -> None:
    first_host, _ = cable.hosts
    arguments = cable.arguments(
        "ros1", first_host, discovery="master", server="127.0.0.1", settings={"patience_s": "0.1"}
    )
    with first_host.start(
        (sys.executable, str(cable.program), "publish", json.dumps(arguments), str(tmp_path / "log"))
    ) as process:
        _, output_text = process.communicate(timeout=60)
    assert process.returncode == 3
    assert output_text == b"error: no ROS master answers at http://127.0.0.1:11311\n"


@pytest.mark.parametrize("argv", [[], ["publish"], ["route", "{}", "log"], ["other", "{}"]])
def test_invalid_command_line_is_rejected(argv: list[str], tmp_path: Path) -> None:
    program = tmp_path / "agent.pyz"
    program.write_bytes(agent.content())
    completed = subprocess.run((sys.executable, program, *argv), capture_output=True, check=False)
    assert (completed.returncode, completed.stderr[:6]) == (2, b"usage:")


def test_log_without_disk_space_is_reported(tmp_path: Path) -> None:
    program = tmp_path / "agent.pyz"
    program.write_bytes(agent.content())
    arguments = json.dumps({"stream": {"over": "dds", **STREAM}})
    argv = ("prlimit", "--fsize=1000", sys.executable, program, "subscribe", arguments, tmp_path / "log")
    completed = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert completed.returncode == 3
    assert completed.stderr == f"error: the log {tmp_path / 'log'} cannot be written: File too large\n"


def test_missing_middleware_is_reported(tmp_path: Path) -> None:
    program = tmp_path / "agent.pyz"
    program.write_bytes(agent.content())
    arguments = json.dumps({"stream": {"over": "zenoh", **STREAM}})
    # Isolated and without site-packages, Python has only its standard library.
    argv = (sys.executable, "-I", "-S", program, "publish", arguments, tmp_path / "log")
    completed = subprocess.run(argv, capture_output=True, check=False)
    assert completed.returncode == 3
    assert completed.stderr.startswith(b"error: zenoh is not installed here: ")


def send_hostile_packets(host: TestHost, *arguments: str) -> None:
    """Let a host send hostile packets, and wait until it has finished."""
    argv = ("env", f"PYTHONPATH={ROOT}", sys.executable, "-m", "tests.helpers.hostile_wire", *arguments)
    with host.start(argv) as process:
        _, output_text = process.communicate(timeout=120)
    assert output_text.endswith(b"done\n"), output_text.decode()


@contextmanager
def streaming_during_attack(cable: Cable, tmp_path: Path, middleware_name: str, **network: object) -> Iterator[Path]:
    """Stream from one host to the other while the body runs; both programs must survive and stop cleanly after it.

    Yields the log of the received samples.
    """
    first_host, second_host = cable.hosts
    received_log, sent_log = tmp_path / "received", tmp_path / "sent"
    subscriber_arguments = cable.arguments(middleware_name, first_host, peers=(second_host.address,), **network)
    publisher_arguments = cable.arguments(middleware_name, second_host, peers=(first_host.address,), **network)
    endless = {**publisher_arguments, "stream": {**publisher_arguments["stream"], "duration_s": 600.0}}
    with cable.running(first_host, "subscribe", subscriber_arguments, str(received_log)) as subscriber:
        with cable.running(second_host, "publish", endless, str(sent_log)) as publisher:
            yield received_log
            assert publisher.poll() is None
        assert subscriber.poll() is None
    assert (subscriber.returncode, publisher.returncode) == (0, 0)
    for log in (sent_log, received_log):
        assert records.SAMPLE in {row[0] for row in topic_logs.rows(log)}
        assert topic_logs.rows(log)[-1][0] == records.END


@pytest.mark.emulated
def test_changed_rtps_messages_stop_neither_program(cable: Cable, tmp_path: Path) -> None:
    """Their messages may be lost permanently, because RTPS accepts packets in the name of another participant."""
    with streaming_during_attack(cable, tmp_path, "dds"):
        send_hostile_packets(cable.hosts[1], "rtps", "1000")


@pytest.mark.emulated
def test_forged_heartbeat_silences_a_subscription(cable: Cable, tmp_path: Path) -> None:
    """CycloneDDS follows RTPS: samples before the oldest available one are lost; see docs/studies/hostile.md."""
    with streaming_during_attack(cable, tmp_path, "dds") as received_log:
        send_hostile_packets(cable.hosts[1], "heartbeat")
        last_sequence = newest(tmp_path / "sent") + 1  # sent, and perhaps not yet in the log
        wait_until(lambda: newest(tmp_path / "sent") > last_sequence + 50, Deadline.after(60))
        assert 0 <= newest(received_log) <= last_sequence


def sequences(log: Path) -> list[int]:
    """Return the sequence numbers of the samples in a log."""
    return [row[3] for row in topic_logs.rows(log) if row[0] == records.SAMPLE]


def newest(log: Path) -> int:
    """Return the highest sequence number of the samples in a log, -1 if there are none."""
    return max(sequences(log), default=-1)


@pytest.mark.emulated
def test_invalid_tcpros_data_stop_neither_program(cable: Cable, tmp_path: Path) -> None:
    first_host, second_host = cable.hosts
    network = {"discovery": "master", "server": first_host.address, "settings": {"tcpros_port": "40001"}}
    with ExitStack() as stack:
        process = stack.enter_context(first_host.start(("rosmaster", "--core", "-p", "11311")))
        stack.callback(process.terminate)
        with streaming_during_attack(cable, tmp_path, "ros1", **network) as received_log:
            send_hostile_packets(
                second_host,
                "tcpros",
                f"http://{first_host.address}:11311",
                f"{first_host.address}:40001",
                f"{second_host.address}:40001",
            )
            sequences_before = set(sequences(received_log))
            deadline_s = time.monotonic() + 60
            while set(sequences(received_log)) <= sequences_before:
                assert time.monotonic() < deadline_s, "no more samples arrive"
