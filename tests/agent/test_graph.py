"""What participants tell of their nodes: bytes that rosbags writes for the same message of ROS 2."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent import graph
from fieldkit.ros import names
from fieldkit.ros.types import Distribution, MessageTypes

TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
GUIDS = st.binary(min_size=16, max_size=16)
KNOWN = {one: MessageTypes(one) for one in (Distribution.FOXY, Distribution.JAZZY)}


@pytest.mark.parametrize("distribution", KNOWN)
@given(GUIDS, st.from_regex(r"[a-z][a-z0-9_]{0,20}", fullmatch=True), st.lists(GUIDS), st.lists(GUIDS))
def test_it_has_the_bytes_that_rosbags_writes(
    distribution: Distribution, participant: bytes, node: str, readers: list[bytes], writers: list[bytes]
) -> None:
    store, size = KNOWN[distribution].ros2, distribution.gid_bytes
    kinds: Any = store.types

    def gid(guid: bytes) -> Any:  # noqa: ANN401 (of rosbags)
        return kinds["rmw_dds_common/msg/Gid"](np.frombuffer(guid.ljust(size, b"\0"), np.uint8))

    ends = [[gid(one) for one in guids] for guids in (readers, writers)]
    told = kinds[TYPE](gid(participant), [kinds["rmw_dds_common/msg/NodeEntitiesInfo"]("/", node, *ends)])
    assert graph.entities_info(participant, node, readers, writers, size) == bytes(store.serialize_cdr(told, TYPE))


@pytest.mark.parametrize("distribution", KNOWN)
def test_its_members_are_those_of_the_distribution(distribution: Distribution) -> None:
    fields = KNOWN[distribution].fields(TYPE)
    told = graph.topic(distribution.gid_bytes)
    # What bounds a name matters to nobody who reads it.
    wanted = {name: [(one.name, one.type, one.count) for one in of] for name, of in fields.items()}
    assert {name: [tuple(one) for one in of] for name, of in told.members.items()} == wanted
    assert told.dds_types == {name: names.dds_type(name) for name in fields}
