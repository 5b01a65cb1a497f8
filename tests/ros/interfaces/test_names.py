"""Names of topics and tokens, compared with examples in docs/design.md of rmw_zenoh and in public projects."""

import pytest

from fieldkit.ros.interfaces import names
from fieldkit.ros.interfaces.names import Endpoint, Entity, Token
from fieldkit.ros.interfaces.qos import PROFILES, QosProfile
from fieldkit.ros.interfaces.types import standard_types

STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"%chatter/std_msgs::msg::dds_::String_/{STRING}"
LISTENER = "aac3178e146ba6f1fc6e6a4085e77f21"
TALKER = "8b20917502ee955ac4476e0266340d5c"

# These tokens are from design.md; the depths are those of its demo nodes.
NODE = f"@ros2_lv/0/{LISTENER}/0/0/NN/%/%/listener"
SUBSCRIPTION = f"@ros2_lv/0/{LISTENER}/0/10/MS/%/%/listener/{CHATTER}/::,10:,:,:,,"
PUBLISHER = f"@ros2_lv/0/{TALKER}/0/10/MP/%/%/talker/{CHATTER}/::,7:,:,:,,"


def token(entity: Entity, session: str, node: str, depth: int) -> Token:
    endpoint = Endpoint("/chatter", "std_msgs/msg/String", STRING, QosProfile(depth=depth))
    return Token(0, session, 0, 10, entity, node, endpoint=endpoint)


def test_tokens_are_those_of_the_design_document() -> None:
    assert Token(0, LISTENER, 0, 0, Entity.NODE, "listener").key == NODE
    assert token(Entity.SUBSCRIPTION, LISTENER, "listener", 10).key == SUBSCRIPTION
    assert token(Entity.PUBLISHER, TALKER, "talker", 7).key == PUBLISHER


def test_key_of_a_topic_is_that_of_the_design_document() -> None:
    assert names.zenoh_key(0, "/chatter", "std_msgs/msg/String", STRING) == (
        f"0/chatter/std_msgs::msg::dds_::String_/{STRING}"
    )
    assert names.zenoh_key(2, "/robot1/chatter", "std_msgs/msg/String", STRING) == (
        f"2/robot1/chatter/std_msgs::msg::dds_::String_/{STRING}"
    )


@pytest.mark.parametrize(("topic", "mangled"), [("/scan", "rt/scan"), ("/robot1/scan", "rt/robot1/scan")])
def test_the_dds_name_of_a_topic_has_the_prefix_of_ros(topic: str, mangled: str) -> None:
    assert names.dds_topic(topic) == mangled


def test_the_dds_name_of_a_type_has_the_namespace_and_suffix_of_ros() -> None:
    assert names.dds_type("sensor_msgs/msg/LaserScan") == "sensor_msgs::msg::dds_::LaserScan_"


def test_user_data_contains_the_hash() -> None:
    """The hash is the example in test_qos.cpp of rmw_dds_common."""
    example_hash = "RIHS01_" + "".join(f"{byte:02x}" for byte in range(32))
    assert names.user_data(example_hash) == (
        "typehash=RIHS01_000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f;"
    )
    assert names.user_data("") == ""


def test_the_token_of_a_subscription_contains_its_quality() -> None:
    """The token is the one of public projects for rmw_zenoh, with best effort and 5 samples."""
    type_hash = standard_types().get("std_msgs/Bool").rihs01
    endpoint = Endpoint("/rovi/arm", "std_msgs/msg/Bool", type_hash, PROFILES["sensor_data"])
    assert Token(0, LISTENER, 0, 2, Entity.SUBSCRIPTION, "rovi", endpoint=endpoint).key.endswith(
        "/MS/%/%/rovi/%rovi%arm/std_msgs::msg::dds_::Bool_/"
        "RIHS01_feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9/2::,5:,:,:,,"
    )
