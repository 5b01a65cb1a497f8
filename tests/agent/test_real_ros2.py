"""The agent beside a real ROS 2: rclpy of Kilted over Fast DDS, from packages of its own (`.ci/install --dev`)."""

import json
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.agent import records
from fieldkit.agent.stream import HEAD, SampleCodec, Stream
from fieldkit.remote import agent
from fieldkit.ros import topics
from fieldkit.ros.qos import PROFILES
from fieldkit.ros.types import shipped
from tests.helpers.paths import ROOT
from tests.helpers.two_hosts import TestHost, cabled

ROS2 = ROOT / ".ros2" / "bin" / "python"
NODE = ROOT / "tests" / "agent" / "ros2_node.py"
TYPE = "std_msgs/msg/UInt8MultiArray"
DOMAIN = 3
COUNT = 20
# Of a length that is no multiple of 4, so that it is filled on the wire.
SIZE = 201


def told(host: TestHost, topic: str, node: str) -> str:
    described = topics.describe(shipped(), topic, TYPE, PROFILES["default"], domain=DOMAIN, node=node)
    network = {"address": host.address, "domain": DOMAIN, "node": node}
    stream = {"over": "dds", "size_bytes": SIZE, "rate_hz": 20.0, "duration_s": 3.0, "patience_s": 60.0}
    return json.dumps({"network": network, "topic": described, "stream": stream})


def samples(path: Path) -> dict[int, int]:
    """Return when each sample in a log was sent, by its number."""
    found = records.RECORD.iter_unpack(path.read_bytes()[len(records.MAGIC) :])
    return {sequence: sent_ns for kind, _, _, sequence, sent_ns, _ in found if kind == records.SAMPLE}


@pytest.mark.emulated
def test_a_real_node_hears_the_agent_and_is_heard(tmp_path: Path) -> None:
    program = tmp_path / "agent.pyz"
    program.write_bytes(agent.content())
    sent, came = tmp_path / "sent", tmp_path / "came"
    command = (sys.executable, str(program))
    with (
        cabled() as (near, far),
        near.start((*command, "subscribe", told(near, "/again", "ears"), str(came))) as ears,
        near.start((*command, "publish", told(near, "/stream", "mouth"), str(sent))) as mouth,
    ):
        environment = ("env", f"ROS_DOMAIN_ID={DOMAIN}", f"ROS_HOME={tmp_path}")
        inside = ("nsenter", "-t", str(far.pid), "-n", *environment, str(ROS2), str(NODE), str(COUNT), TYPE)
        said = subprocess.run(inside, capture_output=True, check=False, timeout=120)
        mouth.communicate(timeout=120)
        ears.send_signal(signal.SIGINT)
        ears.communicate(timeout=30)
    assert said.returncode == 0, said.stderr
    seen = json.loads(said.stdout)
    assert (seen["type"], seen["hash"]) == (TYPE, shipped().get(TYPE).rihs01)
    assert (seen["reliability"], seen["depth"]) == ("RELIABLE", PROFILES["default"].depth)
    assert seen["subscribers"] == [TYPE]

    times = samples(sent)
    made = SampleCodec(Stream("dds", SIZE, 20.0, 3.0, 60.0))
    assert len(seen["heard"]) == COUNT
    for heard, again in zip(map(bytes.fromhex, seen["heard"]), map(bytes.fromhex, seen["again"]), strict=True):
        _, sequence, sent_ns = HEAD.unpack_from(heard, struct.calcsize("<4sIII"))
        whole = made.encode(sequence, sent_ns)
        assert times[sequence] == sent_ns
        # As ROS 2 itself serializes the message, but for what fills the last word.
        assert again.startswith(whole)
        assert len(again) - len(whole) < 4
    back = samples(came)
    assert back
    assert all(times[sequence] == sent_ns for sequence, sent_ns in back.items())
