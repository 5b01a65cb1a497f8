"""Messages of any type from its definition: rosbags reads each field back, and sizes are as requested."""

import struct
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fieldkit.config import schema
from fieldkit.config.profiles import PublishedTopic
from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.provisioning import _sensor, definition
from sim_backends.emulated.ros import messages, templates

LIDAR = """\
std_msgs/Header header
uint16 CHANNELS=128
my_msgs/Packet[] packets
my_msgs/Packet first
string[2] names
geometry_msgs/Pose pose
float32[3] bias
int16[] ranges
uint8[] rest
================================================================================
MSG: my_msgs/Packet
time stamp
duration took
uint8[] data
bool good
"""
PLAIN = "int32 number\nfloat32[] samples\n"


def topic(text: str) -> PublishedTopic:
    return schema.validate(schema.parse(f"{{name: /x, rate: 10Hz, frame: lens, {text}}}", source="x"), PublishedTopic)


def read_message(topic: PublishedTopic) -> Any:  # noqa: ANN401 (rosbags makes its classes as it goes)
    store = get_typestore(Stores.ROS1_NOETIC)
    message_type = topic.type.replace("/", "/msg/")
    if topic.definition:
        store.register(get_types_from_msg(topic.definition, message_type))
    data = messages.Source(_sensor(topic)).message(7, 1_500_000_000_123_456_789)
    message = store.deserialize_ros1(data, message_type)
    assert bytes(store.serialize_ros1(message, message_type)) == data, "to the last byte"
    return message


def custom_topic(definition: str, keys: str) -> PublishedTopic:
    return topic(f"type: my_msgs/Scan, {keys}").model_copy(update={"definition": definition})


def test_an_image_has_the_size_in_its_fields() -> None:
    message = read_message(topic("type: sensor_msgs/Image, width: 640, height: 480"))
    assert (message.width, message.height, message.step, message.encoding) == (640, 480, 1920, "rgb8")
    assert len(message.data) == 640 * 480 * 3
    assert (message.header.seq, message.header.stamp.nanosec, message.header.frame_id) == (7, 123_456_789, "lens")
    assert len(np.unique(message.data)) > 200, "incompressible"


def test_a_compressed_image_has_the_requested_size() -> None:
    message = read_message(topic("type: sensor_msgs/CompressedImage, size: 1MB"))
    assert (message.format, len(message.data)) == ("jpeg", 1_000_000)


def test_a_point_cloud_holds_finite_points_of_four_floats() -> None:
    cloud = topic("type: sensor_msgs/PointCloud2, points: 1000")
    message = read_message(cloud)
    assert [(field.name, field.offset, field.datatype, field.count) for field in message.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("intensity", 12, 7, 1),
    ]
    assert (message.width, message.height, message.point_step, message.row_step) == (1000, 1, 16, 16_000)
    points = message.data.view(np.float32)
    assert len(points) == 4000
    assert np.isfinite(points).all()
    assert abs(float(points.std()) - 1) < 0.1
    source = messages.Source(_sensor(cloud))
    assert source.message(1, 0)[20:] != source.message(2, 0)[20:]


def test_a_message_of_a_custom_type_is_filled_by_its_definition() -> None:
    message = read_message(custom_topic(LIDAR, "size: 3kB"))
    assert len(message.packets) == 0
    assert len(message.first.data) == 3000, "the first list of numbers, also in an inner message"
    assert (len(message.ranges), len(message.rest), message.names) == (0, 0, ["", ""])
    assert (message.pose.orientation.w, message.pose.orientation.x) == (1.0, 0.0)
    assert not message.bias.any()


def test_a_type_without_a_header_begins_with_its_fields() -> None:
    message = read_message(custom_topic(PLAIN, "size: 400B"))
    assert (message.number, len(message.samples)) == (0, 100)
    assert np.isfinite(message.samples).all()


def test_a_ros_type_needs_neither_definition_nor_size() -> None:
    message = read_message(topic("type: nav_msgs/Path"))
    assert len(message.poses) == 0
    assert message.header.frame_id == "lens"


def test_the_md5_sum_of_a_definition_is_that_of_ros() -> None:
    assert definition("sensor_msgs/Image").md5 == "060021388200f6f0f447d0fcd9c64743"
    assert definition("my_msgs/Two", "std_msgs/Header header\nfloat64 x\n").text.startswith("std_msgs/Header header")


@pytest.mark.parametrize(
    ("topic_spec", "error_text"),
    [
        (topic("type: my_msgs/Scan"), "cannot publish my_msgs/Scan"),
        (custom_topic("other_msgs/Thing thing\n", ""), "cannot publish my_msgs/Scan"),
        (custom_topic("float32 3x = [\n", ""), "definition of my_msgs/Scan cannot be read"),
        (topic("type: std_msgs/String, size: 10B"), "no list of numbers whose size can be 10 bytes"),
        (custom_topic(PLAIN, "size: 401B"), "no list of numbers whose size can be 401 bytes"),
    ],
)
def test_unsupported_types_are_rejected_with_a_remedy(topic_spec: PublishedTopic, error_text: str) -> None:
    with pytest.raises(ConfigurationError, match=error_text) as error_info:
        templates.template_of(topic_spec)
    assert error_info.value.remedy


def test_a_template_has_serialized_head_and_tail() -> None:
    template = templates.template_of(topic("type: sensor_msgs/CompressedImage, size: 5B"))
    assert bytes.fromhex(template.head) == struct.pack("<I", 4) + b"jpeg" + struct.pack("<I", 5)
    assert (template.tail, template.size_bytes, template.has_header, template.floats) == ("", 5, True, False)
