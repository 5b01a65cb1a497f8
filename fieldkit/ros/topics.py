"""A topic of the laptop's words as the agent on a robot is told it (`fieldkit.agent.middleware.Topic`)."""

from typing import Any

from fieldkit.ros import names
from fieldkit.ros.names import Endpoint, Entity, Token
from fieldkit.ros.qos import QosProfile
from fieldkit.ros.types import MessageTypes

SESSION = "{zid}"
"""Stands in a token for the session, which only the robot knows."""


def describe(
    types: MessageTypes, topic: str, type_name: str, qos: QosProfile, *, domain: int, node: str, number: int = 1
) -> dict[str, Any]:
    """Return a topic by all the names that it has on the wire, for JSON.

    Args:
        types: Where its type is known.
        topic: `/scan`.
        type_name: `sensor_msgs/msg/LaserScan`.
        qos: Its quality of service.
        domain: ROS domain.
        node: Name of the node that has it.
        number: Of its end among those of the node.

    Raises:
        ConfigurationError: There is no such type.
    """
    found = types.get(type_name)
    members = types.fields(found.name) if found.rihs01 else {}
    rihs01 = found.rihs01 if types.distribution.tells_hashes else ""
    endpoint = Endpoint(topic, found.name, rihs01 or names.NO_HASH, qos)
    of_node = Token(domain, SESSION, 0, 0, Entity.NODE, node).key
    ends = {
        end: (of_node, Token(domain, SESSION, 0, number, entity, node, endpoint=endpoint).key)
        for end, entity in (("publisher", Entity.PUBLISHER), ("subscription", Entity.SUBSCRIPTION))
    }
    return {
        "name": topic,
        "type": found.name,
        "quality": {
            "reliability": qos.reliability.name.lower(),
            "history": qos.history.name.lower(),
            "depth": qos.depth,
            "durability": qos.durability.name.lower(),
            "deadline_ns": qos.deadline_ns,
            "lifespan_ns": qos.lifespan_ns,
        },
        "members": {
            name: [(member.name, member.type, member.count) for member in of] for name, of in members.items()
        },
        "dds_topic": names.dds_topic(topic),
        "dds_types": {name: names.dds_type(name) for name in members},
        "user_data": names.user_data(rihs01),
        "key": names.zenoh_key(domain, topic, found.name, rihs01 or names.NO_HASH),
        "tokens": ends,
        "md5": found.md5,
        "definition": found.definition,
    }
