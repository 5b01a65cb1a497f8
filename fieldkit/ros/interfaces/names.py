"""Names of topics, types and nodes in ROS 2 over DDS, and in rmw_zenoh.

Sources for DDS: design.ros2.org, "Topic and Service name mapping to DDS" and "Interface definition and language
mapping". Source for Zenoh: docs/design.md of github.com/ros2/rmw_zenoh since version 0.3, sections Publishers and
Graph Cache.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from fieldkit.ros.interfaces import qos
from fieldkit.ros.interfaces.qos import QosProfile

ADMIN_SPACE: Final = "@ros2_lv"
"""Prefix of all liveliness tokens of rmw_zenoh."""

NO_HASH: Final = "TypeHashNotSupported"
"""Placeholder for the hash of a type in rmw_zenoh of Humble, where ROS 2 has no type hashes."""

_TOPIC_PREFIX: Final = "rt"


def dds_type(name: str) -> str:
    """Return the DDS name of a message type, for example `sensor_msgs::msg::dds_::LaserScan_`."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def dds_topic(topic: str) -> str:
    """Return the DDS name of a topic, for example `rt/scan` for `/scan`."""
    return f"{_TOPIC_PREFIX}/{topic.lstrip('/')}"


def user_data(rihs01: str) -> str:
    """Return the user data of a DDS endpoint: the type hash (rmw_dds_common, qos.cpp); empty for an empty hash.

    Distributions before ROS 2 Iron have no type hashes.
    """
    return f"typehash={rihs01};" if rihs01 else ""


def zenoh_key(domain: int, topic: str, type_name: str, rihs01: str) -> str:
    """Return the key expression under which rmw_zenoh publishes a topic."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{rihs01}"


class Entity(StrEnum):
    """Kind of entity in a liveliness token."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"


@dataclass(frozen=True)
class Endpoint:
    """A publisher or a subscription.

    Attributes:
        topic: Name of the topic, for example `/scan`.
        type_name: Its type, for example `sensor_msgs/msg/LaserScan`.
        rihs01: Hash of the type, or `NO_HASH`.
        qos: Its quality of service.
    """

    topic: str
    type_name: str
    rihs01: str
    qos: QosProfile


@dataclass(frozen=True)
class Token:
    """A liveliness token, which announces a node or an endpoint.

    Attributes:
        domain: Its ROS domain.
        session: Identifier of its Zenoh session, hexadecimal.
        node_id: Number of the node in its session.
        entity_id: Number of the entity in the session; for a node equal to `node_id`.
        entity: Kind of entity.
        node: Name of the node.
        namespace: Namespace of the node.
        enclave: Enclave of the node.
        endpoint: The endpoint; None for a node.
    """

    domain: int
    session: str
    node_id: int
    entity_id: int
    entity: Entity
    node: str
    namespace: str = "/"
    enclave: str = "/"
    endpoint: Endpoint | None = None

    @property
    def key(self) -> str:
        """The key expression to declare."""
        head = (
            ADMIN_SPACE,
            str(self.domain),
            self.session,
            str(self.node_id),
            str(self.entity_id),
            self.entity.value,
        )
        node = (_mangled(self.enclave), _mangled(self.namespace), _mangled(self.node))
        if self.endpoint is None:
            return "/".join((*head, *node))
        endpoint = self.endpoint
        return "/".join(
            (
                *head,
                *node,
                _mangled(endpoint.topic),
                dds_type(endpoint.type_name),
                endpoint.rihs01,
                qos.to_zenoh(endpoint.qos),
            )
        )


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"
