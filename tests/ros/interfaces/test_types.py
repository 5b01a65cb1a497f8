"""Message types, compared with published hashes and MD5 sums."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import Distribution, MessageField, MessageTypes, standard_types
from tests.helpers.paths import DATA

# The type hash of std_msgs/String is from docs/design.md of ros2/rmw_zenoh. The others are from key expressions and
# generated code of public projects that communicate with ROS 2 nodes (ros-z, users of rmw_zenoh, roslibrust). The MD5
# sums are the output of `rosmsg md5` of ROS Noetic.
PUBLISHED = {
    "std_msgs/msg/String": (
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
        "992ce8a1687cec8c8bd883ec73ca41d1",
    ),
    "sensor_msgs/msg/LaserScan": (
        "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
        "90c7ef2dc6895d81024acba2ac42f369",
    ),
    "nav_msgs/msg/Odometry": (
        "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
        "cd5e73d190d741a2f92e81eda573aca7",
    ),
    "geometry_msgs/msg/Twist": (
        "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
        "9f195f881246fdfa2798d1d3eebca84a",
    ),
    "tf2_msgs/msg/TFMessage": (
        "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
        "94810edda583a504dfda3829e70d7eec",
    ),
}


@pytest.mark.parametrize(("name", "published"), PUBLISHED.items())
@pytest.mark.parametrize("distribution", Distribution)
def test_hashes_equal_the_published_hashes(name: str, published: tuple[str, str], distribution: Distribution) -> None:
    message_type = standard_types(distribution).get(name)
    assert (message_type.rihs01, message_type.md5) == published


def test_hashes_equal_those_of_a_ros_2_installation() -> None:
    """The hashes are those that rosidl has written to the packages of ROS 2 Kilted."""
    published = json.loads((DATA / "ros2" / "kilted" / "type_hashes.json").read_text(encoding="utf-8"))
    assert len(published) > 100
    assert {name: standard_types().get(name).rihs01 for name in published} == published


def test_a_type_has_two_spellings() -> None:
    assert standard_types().get("sensor_msgs/LaserScan") == standard_types().get("sensor_msgs/msg/LaserScan")


def test_a_custom_type_has_a_hash_and_its_fields() -> None:
    text = "std_msgs/Header header\nfloat32[4] level\nstring<=8 name\nuint8[] raw\nint16[<=3] few\n"
    types = MessageTypes(definitions={"lab_msgs/Radio": text})
    message_type = types.get("lab_msgs/Radio")
    assert len(message_type.rihs01) == len(PUBLISHED["std_msgs/msg/String"][0])
    assert types.fields("lab_msgs/Radio")["lab_msgs/msg/Radio"] == (
        MessageField("header", "std_msgs/msg/Header", None),
        MessageField("level", "float32", 4),
        MessageField("name", "string", None),
        MessageField("raw", "uint8", 0),
        MessageField("few", "int16", -3),
    )
    assert list(types.fields("lab_msgs/Radio"))[1:] == ["std_msgs/msg/Header", "builtin_interfaces/msg/Time"]


def test_md5_sum_is_independent_of_the_name() -> None:
    """The MD5 sum of ROS 1 includes the members but not the name of the type."""
    types = MessageTypes(definitions={"lab_msgs/Words": "string data\n"})
    assert types.get("lab_msgs/Words").md5 == PUBLISHED["std_msgs/msg/String"][1]
    assert types.get("lab_msgs/Words").rihs01 != PUBLISHED["std_msgs/msg/String"][0]


def test_custom_types_do_not_affect_other_instances() -> None:
    MessageTypes(definitions={"lab_msgs/Once": "string data\n"})
    with pytest.raises(ConfigurationError):
        standard_types().get("lab_msgs/Once")


def test_unknown_type_is_reported_with_the_nearest() -> None:
    with pytest.raises(ConfigurationError) as failed:
        standard_types().get("sensor_msgs/LaserScn")
    assert failed.value.remedy == "did you mean 'sensor_msgs/msg/LaserScan'?"


def test_definition_with_an_unknown_type_is_rejected() -> None:
    with pytest.raises(ConfigurationError, match="lab_msgs/msg/Foo"):
        MessageTypes(definitions={"lab_msgs/Radio": "Foo bar\n"})


@given(st.text(max_size=60))
def test_any_text_is_a_definition_or_is_rejected(text: str) -> None:
    try:
        types = MessageTypes(definitions={"lab_msgs/Any": text})
    except ConfigurationError:
        return
    assert types.get("lab_msgs/Any").rihs01


@pytest.mark.parametrize(("name", "hashes"), [("foxy", False), ("humble", False), ("iron", True), ("rolling", True)])
def test_hashes_are_announced_since_iron(name: str, *, hashes: bool) -> None:
    distribution = Distribution.of(name)
    assert (distribution.has_type_hashes, distribution.gid_bytes) == (hashes, 16 if hashes else 24)
    types, quality = MessageTypes(distribution), PROFILES["default"]
    description = topics.describe(types, "/scan", "sensor_msgs/LaserScan", quality, domain=0, node="n")
    type_hash = types.get("sensor_msgs/LaserScan").rihs01
    assert description["user_data"] == (f"typehash={type_hash};" if hashes else "")
    announced_hash = type_hash if hashes else "TypeHashNotSupported"
    assert description["key"] == f"0/scan/sensor_msgs::msg::dds_::LaserScan_/{announced_hash}"
    assert f"/{announced_hash}/" in description["tokens"]["publisher"][1]
