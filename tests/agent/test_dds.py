"""The CycloneDDS adapter: configuration, QoS policies, and types compared with the serialization of rosbags."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.messaging import dds
from fieldkit.agent.messaging.middleware import MiddlewareError, Network, Quality, Topic
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import MessageTypes, standard_types
from fieldkit.ros.middlewares import tuning

CUSTOM_TYPE = (
    "float32[4] level\nstring name\nuint8[] raw\nint16[<=3] few\nbool good\nbyte one\nfloat64 wide\nint64[2] big\n"
)


def topic(name: str, message_types: MessageTypes | None = None) -> Topic:
    message_types = message_types or standard_types()
    return Topic.from_json(topics.describe(message_types, "/t", name, PROFILES["default"], domain=0, node="n"))


def test_serialized_scan_equals_that_of_rosbags() -> None:
    store = standard_types().ros2
    message_classes = {name: store.types[f"{name}"] for name in topic("sensor_msgs/LaserScan").members}
    time, header = message_classes["builtin_interfaces/msg/Time"](5, 6), message_classes["std_msgs/msg/Header"]
    ranges = np.arange(360, dtype=np.float32)
    message = message_classes["sensor_msgs/msg/LaserScan"](header(time, "base"), 0, 1, 2, 3, 4, 5, 6, ranges, ranges)
    written = bytes(store.serialize_cdr(message, "sensor_msgs/msg/LaserScan"))

    scan = dds.struct_type(topic("sensor_msgs/LaserScan"))
    parsed_message = scan.deserialize(written)  # type: ignore[attr-defined]
    assert parsed_message.header.frame_id == "base"
    assert parsed_message.serialize(use_version_2=False) == written


@pytest.mark.parametrize(
    "name",
    ["nav_msgs/Odometry", "sensor_msgs/Imu", "sensor_msgs/BatteryState", "geometry_msgs/Twist", "tf2_msgs/TFMessage"],
)
def test_all_types_of_robots_can_be_built(name: str) -> None:
    """The binding reads and writes an all-zero message with the same size as rosbags."""
    topic_description = topic(name)
    struct = dds.struct_type(topic_description)
    empty = bytes((0, 1, 0, 0)) + bytes(2000)
    parsed_message = struct.deserialize(empty)  # type: ignore[attr-defined]
    written = parsed_message.serialize(use_version_2=False)
    store = standard_types().ros2
    converted = store.serialize_cdr(store.deserialize_cdr(written, topic_description.type), topic_description.type)
    assert bytes(converted) == written


def test_custom_type_can_be_built() -> None:
    types = MessageTypes(definitions={"lab_msgs/Radio": CUSTOM_TYPE})
    message_class = types.ros2.types["lab_msgs/msg/Radio"]
    level, raw = np.array([1, 2, 3, 4], np.float32), np.array([9, 8], np.uint8)
    message = message_class(
        level, "x", raw, np.array([1], np.int16), good=True, one=7, wide=0.5, big=np.array([1, 2], np.int64)
    )
    written = bytes(types.ros2.serialize_cdr(message, "lab_msgs/msg/Radio"))
    parsed_message = dds.struct_type(topic("lab_msgs/Radio", types)).deserialize(written)  # type: ignore[attr-defined]
    assert (parsed_message.name, parsed_message.few, parsed_message.good, parsed_message.wide) == (
        "x",
        [1],
        True,
        0.5,
    )
    assert parsed_message.serialize(use_version_2=False) == written


def test_types_have_the_dds_names_of_ros_2() -> None:
    struct = dds.struct_type(topic("sensor_msgs/LaserScan"))
    assert struct.__idl__.idl_transformed_typename == "sensor_msgs::msg::dds_::LaserScan_"  # type: ignore[attr-defined]


@given(st.binary(min_size=4, max_size=64))
def test_padding_is_reversible(data: bytes) -> None:
    sample = data[:3] + bytes([data[3] & ~3]) + data[4:]
    assert len(dds.padded(sample)) % 4 == 0
    assert dds.unpadded(dds.padded(sample)) == sample


def test_configuration_contains_one_interface_and_the_peers() -> None:
    network = Network(
        "10.0.0.1", discovery="peers", peers=("10.0.0.2",), settings={"Discovery/SPDPInterval": "500 ms"}
    )
    (domain,) = ET.fromstring(dds.configuration(network))
    assert [element.get("address") for element in domain.iter("NetworkInterface")] == ["10.0.0.1"]
    assert [element.get("address") for element in domain.iter("Peer")] == ["10.0.0.2"]
    assert domain.findtext("General/AllowMulticast") == "false"
    assert domain.findtext("Discovery/SPDPInterval") == "500 ms"
    assert domain.findtext("Discovery/ParticipantIndex") == "auto"


def test_setting_may_be_an_attribute() -> None:
    network = Network("10.0.0.1", settings={"Internal/SocketReceiveBufferSize@min": '10"MB'})
    (element,) = ET.fromstring(dds.configuration(network)).iter("SocketReceiveBufferSize")
    assert element.attrib == {"min": '10"MB'}


def test_library_accepts_the_recommended_settings() -> None:
    """CycloneDDS does not start with an unknown element."""
    settings = dict(tuning.recommended_settings("dds", "tcp"))
    dds.start(Network("127.0.0.1", discovery="peers", domain=97, settings=settings)).close()
    with pytest.raises(MiddlewareError, match="does not start"):
        dds.start(Network("127.0.0.1", discovery="peers", domain=97, settings={**settings, "General/Mox": "1"}))


def test_settings_are_escaped() -> None:
    network = Network("10.0.0.1", settings={"Discovery/Tag": "<x/>&"})
    assert ET.fromstring(dds.configuration(network)).findtext("Domain/Discovery/Tag") == "<x/>&"


@pytest.mark.parametrize(
    ("quality", "policies"),
    [
        (Quality(), ["Policy.Reliability.Reliable", "Policy.History.KeepLast", "Policy.Durability.Volatile"]),
        (
            Quality("best_effort", "keep_all", 5, "transient_local", 10**9, 10**9),
            [
                "Policy.Reliability.BestEffort",
                "Policy.History.KeepAll",
                "Policy.Durability.TransientLocal",
                "Policy.DurabilityService",
                "Policy.History.KeepAll",
                "Policy.Deadline",
                "Policy.Lifespan",
            ],
        ),
        (
            Quality(history="keep_all", durability="transient_local", late_reader_depth=2),
            [
                "Policy.Reliability.Reliable",
                "Policy.History.KeepAll",
                "Policy.Durability.TransientLocal",
                "Policy.DurabilityService",
                "Policy.History.KeepLast(depth=2)",
            ],
        ),
        (Quality("system_default", "system_default", 0, "system_default"), []),
    ],
)
def test_quality_of_service_as_dds_policies(quality: Quality, policies: list[str]) -> None:
    qos_text = repr(dds.quality(quality, "typehash=x;", writes=True))
    for policy in (*policies, "Policy.Userdata"):
        assert policy in qos_text
    assert qos_text.count("Policy.") == len(policies) + 2
