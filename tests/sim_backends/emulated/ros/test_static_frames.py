"""`/tf_static` of an emulated robot: every frame is linked to the moving frame, in ROS 1 serialization."""

from typing import Any

import pytest

from fieldkit.config import locations
from fieldkit.config.profiles import load_profile
from fieldkit.ros.interfaces.types import standard_types
from sim_backends.emulated.provisioning import _sensor
from sim_backends.emulated.ros import static_frames


def links_of(profile: str) -> tuple[static_frames.Link, ...]:
    return static_frames.links(map(_sensor, load_profile(profile).topics))


@pytest.mark.parametrize("profile", locations.names("robots"))
def test_every_frame_of_a_shipped_robot_has_one_path_to_the_world(profile: str) -> None:
    links = links_of(profile)
    parent_of = {child: parent for parent, child in links}
    assert len(parent_of) == len(links), "tf2 accepts one parent"
    topics = load_profile(profile).topics
    moving_frames = {topic.child_frame for topic in topics if topic.child_frame} or {static_frames.BASE}
    world_frames = {topic.frame for topic in topics if topic.child_frame} | {"", "map"}
    for topic in topics:
        frame = topic.frame
        while frame in parent_of:
            frame = parent_of[frame]
        assert frame in moving_frames | world_frames, topic.name
    assert not {child for _, child in links} & (moving_frames | world_frames)


def test_a_turtlebots_frames_are_those_of_its_description() -> None:
    assert links_of("turtlebot3_burger") == (
        ("base_footprint", "base_link"),
        ("base_link", "base_scan"),
        ("base_link", "imu_link"),
    )


def test_the_message_can_be_deserialized_by_ros_1() -> None:
    links = (("base_link", "a"), ("base_link", "b"))
    message: Any = standard_types().ros1.deserialize_ros1(
        static_frames.message(links, 3_000_000_004), "tf2_msgs/msg/TFMessage"
    )
    for (parent, child), transform in zip(links, message.transforms, strict=True):
        assert (transform.header.frame_id, transform.child_frame_id) == (parent, child)
        assert (transform.header.stamp.sec, transform.header.stamp.nanosec) == (3, 4)
        translation, rotation = transform.transform.translation, transform.transform.rotation
        assert (translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z, rotation.w) == (
            0,
            0,
            0,
            0,
            0,
            0,
            1,
        )
