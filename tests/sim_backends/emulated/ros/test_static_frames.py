"""`/tf_static` of an emulated robot: every frame is joined to the one that moves, and the bytes are ROS 1's."""

from typing import Any

import pytest

from fieldkit.config import locations
from fieldkit.config.profiles import load_profile
from fieldkit.ros.types import shipped
from sim_backends.emulated.provisioning import _sensor
from sim_backends.emulated.ros import static_frames
from tests.helpers.casts import ros_of


def links_of(profile: str) -> tuple[static_frames.Link, ...]:
    return static_frames.links(map(_sensor, ros_of(load_profile(profile)).topics))


@pytest.mark.parametrize("profile", locations.names("robots"))
def test_every_frame_of_a_shipped_robot_has_one_way_to_the_world(profile: str) -> None:
    joined = links_of(profile)
    lies_in = {child: parent for parent, child in joined}
    assert len(lies_in) == len(joined), "tf2 takes one parent"
    topics = ros_of(load_profile(profile)).topics
    moves = {topic.child_frame for topic in topics if topic.child_frame} or {static_frames.BASE}
    worlds = {topic.frame for topic in topics if topic.child_frame} | {"", "map"}
    for topic in topics:
        frame = topic.frame
        while frame in lies_in:
            frame = lies_in[frame]
        assert frame in moves | worlds, topic.name
    assert not {child for _, child in joined} & (moves | worlds)


def test_a_turtlebots_frames_are_those_of_its_description() -> None:
    assert links_of("turtlebot3_burger") == (
        ("base_footprint", "base_link"),
        ("base_link", "base_scan"),
        ("base_link", "imu_link"),
    )


def test_the_message_is_read_as_ros_1_reads_it() -> None:
    found = (("base_link", "a"), ("base_link", "b"))
    read: Any = shipped().ros1.deserialize_ros1(static_frames.message(found, 3_000_000_004), "tf2_msgs/msg/TFMessage")
    for (parent, child), one in zip(found, read.transforms, strict=True):
        assert (one.header.frame_id, one.child_frame_id) == (parent, child)
        assert (one.header.stamp.sec, one.header.stamp.nanosec) == (3, 4)
        move, turn = one.transform.translation, one.transform.rotation
        assert (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w) == (0, 0, 0, 0, 0, 0, 1)
