"""Node information of DDS participants: compared with the serialization of the ROS 2 message by rosbags."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.messaging import graph
from fieldkit.ros.interfaces import names
from fieldkit.ros.interfaces.types import Distribution, MessageTypes

TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
GUIDS = st.binary(min_size=16, max_size=16)
TYPES_BY_DISTRIBUTION = {
    distribution: MessageTypes(distribution) for distribution in (Distribution.FOXY, Distribution.JAZZY)
}


@pytest.mark.parametrize("distribution", TYPES_BY_DISTRIBUTION)
@given(GUIDS, st.from_regex(r"[a-z][a-z0-9_]{0,20}", fullmatch=True), st.lists(GUIDS), st.lists(GUIDS))
def test_message_equals_that_of_rosbags(
    distribution: Distribution, participant: bytes, node: str, readers: list[bytes], writers: list[bytes]
) -> None:
    store, size = TYPES_BY_DISTRIBUTION[distribution].ros2, distribution.gid_bytes
    message_types: Any = store.types

    def gid(guid: bytes) -> Any:  # noqa: ANN401 (a type of rosbags)
        return message_types["rmw_dds_common/msg/Gid"](np.frombuffer(guid.ljust(size, b"\0"), np.uint8))

    gids = [[gid(guid) for guid in guids] for guids in (readers, writers)]
    actual = message_types[TYPE](
        gid(participant), [message_types["rmw_dds_common/msg/NodeEntitiesInfo"]("/", node, *gids)]
    )
    assert graph.entities_info(participant, node, readers, writers, size) == bytes(store.serialize_cdr(actual, TYPE))


@pytest.mark.parametrize("distribution", TYPES_BY_DISTRIBUTION)
def test_members_match_the_distribution(distribution: Distribution) -> None:
    fields = TYPES_BY_DISTRIBUTION[distribution].fields(TYPE)
    actual = graph.topic(distribution.gid_bytes)
    # The bound of a name has no effect on readers.
    expected = {
        name: [(field.name, field.type, field.count) for field in members] for name, members in fields.items()
    }
    assert {name: [tuple(field) for field in members] for name, members in actual.members.items()} == expected
    assert actual.dds_types == {name: names.dds_type(name) for name in fields}
