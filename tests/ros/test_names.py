"""Names on the wire, against the examples of rmw_zenoh's docs/design.md and tokens seen in public."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.ros import names
from fieldkit.ros.names import Endpoint, Entity, Token
from fieldkit.ros.qos import PROFILES, QosProfile, Reliability
from fieldkit.ros.types import shipped

STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"%chatter/std_msgs::msg::dds_::String_/{STRING}"
LISTENER = "aac3178e146ba6f1fc6e6a4085e77f21"
TALKER = "8b20917502ee955ac4476e0266340d5c"

# As they stand in design.md; the depths are those of its demo nodes.
NODE = f"@ros2_lv/0/{LISTENER}/0/0/NN/%/%/listener"
SUBSCRIPTION = f"@ros2_lv/0/{LISTENER}/0/10/MS/%/%/listener/{CHATTER}/::,10:,:,:,,"
PUBLISHER = f"@ros2_lv/0/{TALKER}/0/10/MP/%/%/talker/{CHATTER}/::,7:,:,:,,"
# Of a newer rmw_zenoh, which appends what backends a publisher has.
APPENDED = (
    f"@ros2_lv/1/{TALKER}/6/17/MP/%/%playback/cam_ros2_bridge/%playback%image_raw/"
    f"sensor_msgs::msg::dds_::Image_/{STRING}/2::,5:,:,:,,/backends:cpu:"
)


def token(entity: Entity, session: str, node: str, depth: int) -> Token:
    endpoint = Endpoint("/chatter", "std_msgs/msg/String", STRING, QosProfile(depth=depth))
    return Token(0, session, 0, 10, entity, node, endpoint=endpoint)


def test_tokens_are_those_of_the_design_document() -> None:
    assert Token(0, LISTENER, 0, 0, Entity.NODE, "listener").key == NODE
    assert token(Entity.SUBSCRIPTION, LISTENER, "listener", 10).key == SUBSCRIPTION
    assert token(Entity.PUBLISHER, TALKER, "talker", 7).key == PUBLISHER


@pytest.mark.parametrize("key", [NODE, SUBSCRIPTION, PUBLISHER])
def test_tokens_are_read_back(key: str) -> None:
    assert Token.parse(key).key == key


def test_a_token_of_a_newer_version_is_read() -> None:
    found = Token.parse(APPENDED)
    assert (found.namespace, found.node) == ("/playback", "cam_ros2_bridge")
    assert found.endpoint is not None
    assert (found.endpoint.topic, found.endpoint.type_name) == ("/playback/image_raw", "sensor_msgs/msg/Image")
    assert found.endpoint.qos.reliability is Reliability.BEST_EFFORT


@pytest.mark.parametrize(
    "key",
    [
        "",
        NODE.replace("NN", "XX"),
        NODE.removesuffix("/listener"),
        NODE.replace("/0/0/", "//0/"),
        SUBSCRIPTION.rpartition("/")[0],
        SUBSCRIPTION.replace("::,10:,:,:,,", "9::,10:,:,:,,"),
        "0/chatter",
    ],
)
def test_what_is_no_token_is_refused(key: str) -> None:
    with pytest.raises(EvidenceError):
        Token.parse(key)


@given(st.text(max_size=80) | st.text("@ros2_lv/%:,01NMPS", max_size=80).map(lambda rest: NODE + rest))
def test_any_text_is_a_token_or_is_refused(key: str) -> None:
    try:
        found = Token.parse(key)
    except EvidenceError:
        return
    assert found.entity in Entity


def test_a_topic_has_the_key_of_the_design_document() -> None:
    assert names.zenoh_key(0, "/chatter", "std_msgs/msg/String", STRING) == (
        f"0/chatter/std_msgs::msg::dds_::String_/{STRING}"
    )
    assert names.zenoh_key(2, "/robot1/chatter", "std_msgs/msg/String", STRING) == (
        f"2/robot1/chatter/std_msgs::msg::dds_::String_/{STRING}"
    )


@pytest.mark.parametrize(("topic", "mangled"), [("/scan", "rt/scan"), ("/robot1/scan", "rt/robot1/scan")])
def test_topics_are_mangled_for_dds(topic: str, mangled: str) -> None:
    assert names.dds_topic(topic) == mangled
    assert names.ros_topic(mangled) == topic


@pytest.mark.parametrize("name", ["ros_discovery_info", "rq/addRequest", "rt", "scan"])
def test_what_is_no_topic_of_ros_has_no_name_there(name: str) -> None:
    assert names.ros_topic(name) is None


def test_types_are_named_for_dds() -> None:
    assert names.dds_type("sensor_msgs/msg/LaserScan") == "sensor_msgs::msg::dds_::LaserScan_"
    assert names.ros_type("sensor_msgs::msg::dds_::LaserScan_") == "sensor_msgs/msg/LaserScan"
    assert names.ros_type("sensor_msgs::LaserScan") is None


def test_user_data_tell_the_hash() -> None:
    """The example of test_qos.cpp in rmw_dds_common."""
    counted = "RIHS01_" + "".join(f"{byte:02x}" for byte in range(32))
    assert names.user_data(counted) == (
        "typehash=RIHS01_000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f;"
    )
    assert names.user_data("") == ""


def test_a_subscription_with_sensor_data() -> None:
    """As public projects pin it for rmw_zenoh's listeners: best effort, 5 samples."""
    hashed = shipped().get("std_msgs/Bool").rihs01
    endpoint = Endpoint("/rovi/arm", "std_msgs/msg/Bool", hashed, PROFILES["sensor_data"])
    assert Token(0, LISTENER, 0, 2, Entity.SUBSCRIPTION, "rovi", endpoint=endpoint).key.endswith(
        "/MS/%/%/rovi/%rovi%arm/std_msgs::msg::dds_::Bool_/"
        "RIHS01_feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9/2::,5:,:,:,,"
    )
