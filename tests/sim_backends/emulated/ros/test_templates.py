"""Messages of any type by its definition: rosbags reads each field back, and sizes are those that were asked for."""

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


def message(one: PublishedTopic) -> Any:  # noqa: ANN401 (rosbags makes its classes as it goes)
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = one.type.replace("/", "/msg/")
    if one.definition:
        store.register(get_types_from_msg(one.definition, kind))
    data = messages.Source(_sensor(one)).message(7, 1_500_000_000_123_456_789)
    found = store.deserialize_ros1(data, kind)
    assert bytes(store.serialize_ros1(found, kind)) == data, "to the last byte"
    return found


def custom(definition: str, more: str) -> PublishedTopic:
    return topic(f"type: my_msgs/Scan, {more}").model_copy(update={"definition": definition})


def test_an_image_has_the_size_in_pixels_that_it_says() -> None:
    found = message(topic("type: sensor_msgs/Image, width: 640, height: 480"))
    assert (found.width, found.height, found.step, found.encoding) == (640, 480, 1920, "rgb8")
    assert len(found.data) == 640 * 480 * 3
    assert (found.header.seq, found.header.stamp.nanosec, found.header.frame_id) == (7, 123_456_789, "lens")
    assert len(np.unique(found.data)) > 200, "nothing that compresses well"


def test_a_compressed_image_has_the_bytes_that_were_asked_for() -> None:
    found = message(topic("type: sensor_msgs/CompressedImage, size: 1MB"))
    assert (found.format, len(found.data)) == ("jpeg", 1_000_000)


def test_a_point_cloud_holds_finite_points_of_four_floats() -> None:
    one = topic("type: sensor_msgs/PointCloud2, points: 1000")
    found = message(one)
    assert [(field.name, field.offset, field.datatype, field.count) for field in found.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("intensity", 12, 7, 1),
    ]
    assert (found.width, found.height, found.point_step, found.row_step) == (1000, 1, 16, 16_000)
    points = found.data.view(np.float32)
    assert len(points) == 4000
    assert np.isfinite(points).all()
    assert abs(float(points.std()) - 1) < 0.1
    source = messages.Source(_sensor(one))
    assert source.message(1, 0)[20:] != source.message(2, 0)[20:]


def test_a_type_of_the_lab_s_own_is_filled_by_its_definition() -> None:
    found = message(custom(LIDAR, "size: 3kB"))
    assert len(found.packets) == 0
    assert len(found.first.data) == 3000, "the first list of numbers, wherever it stands"
    assert (len(found.ranges), len(found.rest), found.names) == (0, 0, ["", ""])
    assert (found.pose.orientation.w, found.pose.orientation.x) == (1.0, 0.0)
    assert not found.bias.any()


def test_a_type_without_a_header_begins_with_its_fields() -> None:
    found = message(custom(PLAIN, "size: 400B"))
    assert (found.number, len(found.samples)) == (0, 100)
    assert np.isfinite(found.samples).all()


def test_a_type_that_ros_has_needs_neither_definition_nor_size() -> None:
    found = message(topic("type: nav_msgs/Path"))
    assert len(found.poses) == 0
    assert found.header.frame_id == "lens"


def test_the_sum_of_a_definition_is_that_of_ros() -> None:
    assert definition("sensor_msgs/Image").md5 == "060021388200f6f0f447d0fcd9c64743"
    assert definition("my_msgs/Two", "std_msgs/Header header\nfloat64 x\n").text.startswith("std_msgs/Header header")


@pytest.mark.parametrize(
    ("one", "said"),
    [
        (topic("type: my_msgs/Scan"), "cannot publish my_msgs/Scan"),
        (custom("other_msgs/Thing thing\n", ""), "cannot publish my_msgs/Scan"),
        (custom("float32 3x = [\n", ""), "definition of my_msgs/Scan cannot be read"),
        (topic("type: std_msgs/String, size: 10B"), "no list of numbers whose size can be 10 bytes"),
        (custom(PLAIN, "size: 401B"), "no list of numbers whose size can be 401 bytes"),
    ],
)
def test_what_cannot_be_made_is_refused_with_a_remedy(one: PublishedTopic, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said) as caught:
        templates.template_of(one)
    assert caught.value.remedy


def test_a_template_survives_the_way_to_its_robot() -> None:
    made = templates.template_of(topic("type: sensor_msgs/CompressedImage, size: 5B"))
    assert bytes.fromhex(made.head) == struct.pack("<I", 4) + b"jpeg" + struct.pack("<I", 5)
    assert (made.tail, made.size_bytes, made.stamped, made.floats) == ("", 5, True, False)
