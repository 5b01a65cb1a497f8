"""Describe topics for fieldkit's agent on a robot (`fieldkit.agent.messaging.middleware.Topic`)."""

from typing import Any

from fieldkit.ros.interfaces import names
from fieldkit.ros.interfaces.names import Endpoint, Entity, Token
from fieldkit.ros.interfaces.qos import QosProfile
from fieldkit.ros.interfaces.types import MessageTypes

SESSION = "{zid}"
"""Placeholder in a token for the id of the Zenoh session. The agent replaces it when it has opened the session."""


def describe(
    types: MessageTypes, topic: str, type_name: str, qos: QosProfile, *, domain: int, node: str, number: int = 1
) -> dict[str, Any]:
    """Return a topic with its names and types for all middlewares, as the JSON form of the agent's `Topic`.

    Args:
        types: The message types.
        topic: Name of the topic, for example `/scan`.
        type_name: Its type, for example `sensor_msgs/msg/LaserScan`.
        qos: Its quality of service.
        domain: ROS domain.
        node: Name of the node.
        number: Number of its endpoint in the Zenoh session, from 1, different for each topic; 0 is the node.

    Raises:
        ConfigurationError: There is no such type.
    """
    message_type = types.get(type_name)
    members = types.fields(message_type.name) if message_type.rihs01 else {}
    rihs01 = message_type.rihs01 if types.distribution.has_type_hashes else ""
    endpoint = Endpoint(topic, message_type.name, rihs01 or names.NO_HASH, qos)
    node_token = Token(domain, SESSION, 0, 0, Entity.NODE, node).key
    tokens = {
        role: (node_token, Token(domain, SESSION, 0, number, entity, node, endpoint=endpoint).key)
        for role, entity in (("publisher", Entity.PUBLISHER), ("subscription", Entity.SUBSCRIPTION))
    }
    return {
        "name": topic,
        "type": message_type.name,
        "quality": {
            "reliability": qos.reliability.name.lower(),
            "history": qos.history.name.lower(),
            "depth": qos.depth,
            "durability": qos.durability.name.lower(),
            "deadline_ns": qos.deadline_ns,
            "lifespan_ns": qos.lifespan_ns,
        },
        "members": {
            name: [(member.name, member.type, member.count) for member in fields] for name, fields in members.items()
        },
        "dds_topic": names.dds_topic(topic),
        "dds_types": {name: names.dds_type(name) for name in members},
        "user_data": names.user_data(rihs01),
        "key": names.zenoh_key(domain, topic, message_type.name, rihs01 or names.NO_HASH),
        "tokens": tokens,
        "md5": message_type.md5,
        "definition": message_type.definition,
    }
