"""Nodes of a DDS participant: the topic `ros_discovery_info`, which `ros2 node list` reads.

DDS has participants and endpoints; ROS 2 has nodes with endpoints. Each participant publishes which of its endpoints
belong to which node, in a message of rmw_dds_common that every RMW over DDS reads (design.ros2.org, "Node to
Participant mapping"). The message has few fields, so it is serialized here without a library.
"""

from __future__ import annotations

import struct
from typing import Sequence

from fieldkit.agent.messaging.middleware import Quality, Topic

GID_BYTES = 16
"""Length of a GID (the identifier of an endpoint) in the message since ROS 2 Iron; 24 until Humble (rmw/types.h,
RMW_GID_STORAGE_SIZE)."""

PARTICIPANT_DATA = "enclave=/;"
"""User data of a participant since ROS 2 Foxy; rmw_fastrtps ignores participants without them."""

_PACKAGE = "rmw_dds_common/msg"
_GUID_BYTES = 16


def topic(gid_bytes: int = GID_BYTES) -> Topic:
    """Return the topic. Its DDS name has no prefix `rt/`, because it belongs to no node.

    Args:
        gid_bytes: Length of a GID.
    """
    members: dict[str, list[tuple[str, str, int | None]]] = {
        "ParticipantEntitiesInfo": [("gid", "Gid", None), ("node_entities_info_seq", "NodeEntitiesInfo", 0)],
        "Gid": [("data", "uint8", gid_bytes)],
        "NodeEntitiesInfo": [
            ("node_namespace", "string", None),
            ("node_name", "string", None),
            ("reader_gid_seq", "Gid", 0),
            ("writer_gid_seq", "Gid", 0),
        ],
    }
    return Topic(
        name="ros_discovery_info",
        type=f"{_PACKAGE}/ParticipantEntitiesInfo",
        # The quality of service that rmw_dds_common uses: a late-joining reader receives the last sample.
        quality=Quality(depth=1, durability="transient_local"),
        members={
            f"{_PACKAGE}/{name}": [
                (member, f"{_PACKAGE}/{kind}" if kind in members else kind, count) for member, kind, count in layout
            ]
            for name, layout in members.items()
        },
        dds_topic="ros_discovery_info",
        dds_types={f"{_PACKAGE}/{name}": f"rmw_dds_common::msg::dds_::{name}_" for name in members},
    )


def entities_info(
    participant: bytes, node: str, readers: Sequence[bytes], writers: Sequence[bytes], gid_bytes: int = GID_BYTES
) -> bytes:
    """Return the message of a participant with one node, as CDR in little-endian order.

    Args:
        participant: GUID of the participant, 16 bytes.
        node: Name of the node, in the root namespace.
        readers: GUID of each of its readers.
        writers: GUID of each of its writers.
        gid_bytes: Length of a GID, which is a GUID (the identifier in DDS) padded with zeros.
    """
    message = bytearray()

    def add_number(number: int) -> None:
        message.extend(bytes(-len(message) % 4))
        message.extend(struct.pack("<I", number))

    def add_gid(guid: bytes) -> None:
        message.extend(guid + bytes(gid_bytes - _GUID_BYTES))

    add_gid(participant)
    add_number(1)  # the number of nodes
    for text in ("/", node):
        data = text.encode() + b"\0"
        add_number(len(data))
        message.extend(data)
    for guids in (readers, writers):
        add_number(len(guids))
        for guid in guids:
            add_gid(guid)
    return b"\0\1\0\0" + bytes(message)
