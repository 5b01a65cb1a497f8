"""The agent over a real ROS 2: rclpy of Kilted and Fast DDS, installed separately by `.ci/install --dev`."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

import pytest

from fieldkit.agent.messaging import records
from fieldkit.remote import agent
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from tests.helpers.paths import ROOT
from tests.helpers.two_hosts import TestHost, two_connected_hosts

ROS2: Final = str(ROOT / ".ros2" / "bin" / "python")
PYTHONS: Final = {"ros2": ROS2, "dds": sys.executable}
TYPE: Final = "std_msgs/msg/UInt8MultiArray"
DOMAIN: Final = 5
# The large sample needs many datagrams, and no size is a multiple of 4.
SIZES: Final = {"there": 100_001, "back": 1_001}
TIMEOUT_S: Final = 120
MAX_EXCHANGES: Final = 5


def arguments(middleware_name: str, host: TestHost, topic: str, size: int, **quality: object) -> dict[str, Any]:
    node = f"fieldkit_{middleware_name}_{topic}"
    topic_description = topics.describe(
        standard_types(), f"/{topic}", TYPE, PROFILES["default"], domain=DOMAIN, node=node
    )
    topic_description["quality"] |= quality
    stream = {"over": middleware_name, "size_bytes": size, "rate_hz": 20.0, "duration_s": 1.0, "patience_s": 15.0}
    discovery = "environment" if middleware_name == "ros2" else "multicast"
    network = {"address": host.address, "domain": DOMAIN, "node": node, "discovery": discovery}
    return {"network": network, "topic": topic_description, "stream": stream}


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("agent") / "agent.pyz"
    path.write_bytes(agent.content())
    return path


@contextmanager
def running(
    host: TestHost, program: Path, verb: str, arguments: dict[str, Any], log: Path
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a publisher or subscriber while the body runs, in the folder of its log."""
    python = PYTHONS[arguments["stream"]["over"]]
    command = ("env", "-C", str(log.parent), python, str(program), verb, json.dumps(arguments), str(log))
    with host.start(command) as process:
        assert process.stderr is not None
        # Fast DDS may print warnings about types of CycloneDDS before.
        output = list(takewhile(lambda line: not line.startswith(b"up, "), process.stderr))
        assert process.poll() is None, output
        yield process


def read_records(path: Path, kind: int) -> list[tuple[int, ...]]:
    rows = records.RECORD.iter_unpack(path.read_bytes()[len(records.MAGIC) :])
    return [row[2:5] for row in rows if row[0] == kind]


def exchange(program: Path, folder: Path) -> bool:
    """Stream in both directions at the same time; return True if all endpoints matched."""
    with two_connected_hosts() as (ros2_host, dds_host), ExitStack() as stack:

        def start(host: TestHost, middleware_name: str, verb: str, topic: str) -> subprocess.Popen[bytes]:
            topic_arguments = arguments(
                middleware_name, host, topic, SIZES[topic], durability="transient_local", depth=100
            )
            return stack.enter_context(running(host, program, verb, topic_arguments, folder / f"{topic}.{verb}"))

        subscribers = [start(dds_host, "dds", "subscribe", "there"), start(ros2_host, "ros2", "subscribe", "back")]
        publishers = [start(dds_host, "dds", "publish", "back"), start(ros2_host, "ros2", "publish", "there")]
        output = [publisher.communicate(timeout=TIMEOUT_S)[1] for publisher in publishers]
        for subscriber in subscribers:
            subscriber.send_signal(signal.SIGINT)
        output += [subscriber.communicate(timeout=TIMEOUT_S)[1] for subscriber in subscribers]
    assert [process.returncode for process in (*publishers, *subscribers)] == [0] * 4, output
    return all(
        read_records(folder / f"{topic}.{verb}", records.MATCHED)
        for topic in SIZES
        for verb in ("publish", "subscribe")
    )


@pytest.mark.emulated
@pytest.mark.quiet
def test_fast_dds_and_cyclonedds_exchange_samples_through_the_agent(program: Path, tmp_path: Path) -> None:
    """Samples of one implementation arrive unchanged at the other."""
    # On a busy machine CycloneDDS sometimes does not discover an endpoint of Fast DDS that has discovered it.
    assert any(exchange(program, tmp_path) for _ in range(MAX_EXCHANGES))
    for topic in SIZES:
        sent_samples, received_samples = (
            read_records(tmp_path / f"{topic}.{verb}", records.SAMPLE) for verb in ("publish", "subscribe")
        )
        assert sent_samples
        assert [row[1:] for row in received_samples] == [row[1:] for row in sent_samples]


@pytest.mark.emulated
def test_ros_2_node_leaves_no_file_in_the_home_of_its_robot(program: Path, tmp_path: Path) -> None:
    """An unknown RMW is reported by an error message."""
    home, job = tmp_path / "home", tmp_path / "job"
    home.mkdir()
    job.mkdir()
    with two_connected_hosts() as (ros2_host, _):
        for environment, stream_settings, exit_code in (
            ((), {"patience_s": 0.0}, 0),
            # rcl exits the process with this code.
            (("RMW_IMPLEMENTATION=rmw_none_cpp",), {}, 102),
        ):
            request = arguments("ros2", ros2_host, "none", 100)
            request["stream"] |= stream_settings
            command = (
                "env",
                "-C",
                str(job),
                f"HOME={home}",
                *environment,
                ROS2,
                str(program),
                "publish",
                json.dumps(request),
            )
            with ros2_host.start((*command, str(job / "log"))) as process:
                _, output = process.communicate(timeout=TIMEOUT_S)
            assert process.returncode == exit_code, output
            assert (b"rmw_none_cpp" in output) == bool(exit_code)
            assert (b"up, rclpy 9.1.2, rmw_fastrtps_cpp\n" in output) == (not exit_code)
    assert not list(home.iterdir())


PRINT_POLICIES: Final = """
import json, sys
sys.path.insert(0, sys.argv[1])
from fieldkit.agent.messaging import ros2
from fieldkit.agent.messaging.middleware import MiddlewareError, Network, Quality
profile = ros2.profile(Quality("best_effort", "keep_last", 7, "transient_local", 100_000_000, 2_000_000_000))
policies = [profile.reliability.name, profile.history.name, profile.depth, profile.durability.name]
errors = []
try:
    ros2.message_type("lab_msgs/msg/Radio")
except MiddlewareError as error:
    errors = str(error)
settings = {name: ros2.environment(Network("10.0.0.1", discovery=name, peers=("10.0.0.2", "10.0.0.3"), domain=7))
        for name in ("environment", "multicast", "peers")}
print(json.dumps([policies, profile.deadline.nanoseconds, profile.lifespan.nanoseconds, errors, settings]))
"""


@pytest.mark.emulated
def test_network_settings_and_quality_in_rclpy(program: Path) -> None:
    completed = subprocess.run(
        (ROS2, "-c", PRINT_POLICIES, str(program)), capture_output=True, check=False, timeout=TIMEOUT_S
    )
    assert completed.returncode == 0, completed.stderr
    policies, deadline_ns, lifespan_ns, output, network_settings = json.loads(completed.stdout)
    assert policies == ["BEST_EFFORT", "KEEP_LAST", 7, "TRANSIENT_LOCAL"]
    assert (deadline_ns, lifespan_ns) == (100_000_000, 2_000_000_000)
    assert "this ROS 2 has no lab_msgs/msg/Radio" in output
    domain = {"ROS_DOMAIN_ID": "7"}
    assert network_settings == {
        "environment": domain,
        "multicast": domain | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_STATIC_PEERS": ""},
        "peers": domain | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "10.0.0.2;10.0.0.3"},
    }
