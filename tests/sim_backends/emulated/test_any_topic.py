"""A robot publishes an image and a custom type; both rosbag programs record them with their rates and sizes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from fieldkit.config import schema
from fieldkit.config.profiles import PublishedTopic
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Topology
from fieldkit.remote.command import with_environment
from fieldkit.remote.shell import Shell
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.world.world import load_world
from tests.helpers.casts import ros_of

pytestmark = pytest.mark.emulated

TOPICS = """\
- {name: /camera/image_raw, type: sensor_msgs/Image, rate: 10Hz, frame: camera, width: 320, height: 240}
- name: /lidar/packets
  type: our_msgs/Packets
  rate: 20Hz
  size: 12kB
  definition: |
    time stamp
    our_msgs/Packet packet
    ================================================================================
    MSG: our_msgs/Packet
    uint8[] data
"""
LONG_S = 60.0


class Topics(schema.Strict):
    topics: tuple[PublishedTopic, ...]


@pytest.fixture(scope="module", params=[RosChoice.BUILTIN, RosChoice.DEBIAN])
def shell(request: pytest.FixtureRequest) -> Iterator[Shell]:
    indented = TOPICS.replace("\n", "\n  ")
    topics = schema.validate(schema.parse(f"topics:\n  {indented}\n", source="x"), Topics).topics
    robot = EmulatedBackend(None, None).cast(Topology.MASTERLESS)[Role.SENDER]
    profile = robot.profile.model_copy(update={"ros": ros_of(robot.profile).model_copy(update={"topics": topics})})
    cast = {Role.SENDER: robot.model_copy(update={"profile": profile})}
    options, world = EmulatedOptions(), load_world("lawn")
    with testbed.bring_up(cast, options=options, world=world, ros=request.param, seed=1) as emulation:
        yield emulation.shells[Role.SENDER]


def test_both_topics_are_recorded_completely_at_their_rates(shell: Shell, tmp_path: Path) -> None:
    record = ("rosbag", "record", "--duration=3", "-O", "all", "/camera/image_raw", "/lidar/packets")
    argv = with_environment(record, setup=["/opt/ros/noetic/setup.bash"])
    shell.run(argv, deadline=Deadline.after(LONG_S))
    bag = tmp_path / "all.bag"
    shell.fetch(("cat", "all.bag"), bag, deadline=Deadline.after(LONG_S), limit_bytes=1 << 24)
    messages: dict[str, list[Any]] = {"/camera/image_raw": [], "/lidar/packets": []}
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            messages[connection.topic].append(reader.deserialize(data, connection.msgtype))
    images, packets = messages.values()
    assert {(image.width, image.height, len(image.data)) for image in images} == {(320, 240, 320 * 240 * 3)}
    numbers = [image.header.seq for image in images]
    assert numbers == list(range(numbers[0], numbers[0] + len(images))), "no message is lost"
    assert {len(message.packet.data) for message in packets} == {12_000}
    assert 10 <= len(images) <= 31, "3 s of 10 Hz, less the time to subscribe"
    assert 20 <= len(packets) <= 62
