"""The agent with a real ROS 2 node: rclpy of Kilted over Fast DDS, installed separately by `.ci/install --dev`."""

import json
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.stream import HEAD, SampleCodec, Stream
from fieldkit.remote import agent
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from tests.helpers.paths import ROOT
from tests.helpers.two_hosts import TestHost, two_connected_hosts

ROS2 = ROOT / ".ros2" / "bin" / "python"
NODE = ROOT / "tests" / "agent" / "ros2_node.py"
TYPE = "std_msgs/msg/UInt8MultiArray"
DOMAIN = 3
COUNT = 20
# The length is not a multiple of 4, so that the sample is padded.
SIZE = 201


def arguments(host: TestHost, topic: str, node: str) -> str:
    topic_description = topics.describe(standard_types(), topic, TYPE, PROFILES["default"], domain=DOMAIN, node=node)
    network = {"address": host.address, "domain": DOMAIN, "node": node}
    stream = {"over": "dds", "size_bytes": SIZE, "rate_hz": 20.0, "duration_s": 3.0, "patience_s": 60.0}
    return json.dumps({"network": network, "topic": topic_description, "stream": stream})


def samples(path: Path) -> dict[int, int]:
    """Return the send time of each sample in a log, by sequence number."""
    rows = records.RECORD.iter_unpack(path.read_bytes()[len(records.MAGIC) :])
    return {sequence: sent_ns for kind, _, _, sequence, sent_ns, _ in rows if kind == records.SAMPLE}


@pytest.mark.emulated
def test_real_node_and_agent_exchange_samples(tmp_path: Path) -> None:
    program = tmp_path / "agent.pyz"
    program.write_bytes(agent.content())
    sent_log, received_log = tmp_path / "sent", tmp_path / "received"
    command = (sys.executable, str(program))
    with (
        two_connected_hosts() as (agent_ns, ros2_ns),
        agent_ns.start(
            (*command, "subscribe", arguments(agent_ns, "/again", "listener"), str(received_log))
        ) as subscriber,
        agent_ns.start((*command, "publish", arguments(agent_ns, "/stream", "talker"), str(sent_log))) as publisher,
    ):
        environment = ("env", f"ROS_DOMAIN_ID={DOMAIN}", f"ROS_HOME={tmp_path}")
        node_command = ("nsenter", "-t", str(ros2_ns.pid), "-n", *environment, str(ROS2), str(NODE), str(COUNT), TYPE)
        completed = subprocess.run(node_command, capture_output=True, check=False, timeout=120)
        publisher.communicate(timeout=120)
        subscriber.send_signal(signal.SIGINT)
        subscriber.communicate(timeout=30)
    assert completed.returncode == 0, completed.stderr
    report = json.loads(completed.stdout)
    assert (report["type"], report["hash"]) == (TYPE, standard_types().get(TYPE).rihs01)
    assert (report["reliability"], report["depth"]) == ("RELIABLE", PROFILES["default"].depth)
    assert report["subscribers"] == [TYPE]

    sent_ns_by_sequence = samples(sent_log)
    codec = SampleCodec(Stream("dds", SIZE, 20.0, 3.0, 60.0))
    assert len(report["heard"]) == COUNT
    for sample, republished in zip(
        map(bytes.fromhex, report["heard"]), map(bytes.fromhex, report["again"]), strict=True
    ):
        _, sequence, sent_ns = HEAD.unpack_from(sample, struct.calcsize("<4sIII"))
        expected = codec.encode(sequence, sent_ns)
        assert sent_ns_by_sequence[sequence] == sent_ns
        # Equal to the serialization of ROS 2, except for the padding of the last word.
        assert republished.startswith(expected)
        assert len(republished) - len(expected) < 4
    received_samples = samples(received_log)
    assert received_samples
    assert all(sent_ns_by_sequence[sequence] == sent_ns for sequence, sent_ns in received_samples.items())
