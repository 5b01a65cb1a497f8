"""Names of topics, types and nodes on the wire: of ROS 2 over DDS, and of rmw_zenoh.

DDS: "Topic and Service name mapping to DDS" and the mapping of interfaces to IDL, of design.ros2.org.
Zenoh: docs/design.md of github.com/ros2/rmw_zenoh, sections Publishers and Graph Cache, from its version 0.3 on.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from fieldkit.ros import qos
from fieldkit.ros.qos import QosProfile

ADMIN_SPACE: Final = "@ros2_lv"
"""With which every liveliness token of rmw_zenoh begins."""

NO_HASH: Final = "TypeHashNotSupported"
"""Stands for the hash of a type where ROS 2 has none: in rmw_zenoh of Humble."""

_TOPIC_PREFIX: Final = "rt"


def dds_type(name: str) -> str:
    """Return the DDS name of a message type: `sensor_msgs::msg::dds_::LaserScan_`."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def dds_topic(topic: str) -> str:
    """Return the DDS name of a topic: `rt/scan` of `/scan`."""
    return f"{_TOPIC_PREFIX}/{topic.lstrip('/')}"


def user_data(rihs01: str) -> str:
    """Return what a DDS endpoint tells of its type in its user data since ROS 2 Iron (rmw_dds_common, qos.cpp)."""
    return f"typehash={rihs01};" if rihs01 else ""


def zenoh_key(domain: int, topic: str, type_name: str, rihs01: str) -> str:
    """Return the key expression under which rmw_zenoh publishes a topic."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{rihs01}"


class Entity(StrEnum):
    """What a liveliness token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"


@dataclass(frozen=True)
class Endpoint:
    """A publisher or a subscription.

    Attributes:
        topic: `/scan`.
        type_name: `sensor_msgs/msg/LaserScan`.
        rihs01: Its hash.
        qos: Its quality of service.
    """

    topic: str
    type_name: str
    rihs01: str
    qos: QosProfile


@dataclass(frozen=True)
class Token:
    """A liveliness token: that a node, or an endpoint of one, is there.

    Attributes:
        domain: Its ROS domain.
        session: Identifier of its Zenoh session, hexadecimal.
        node_id: Number of the node in its session.
        entity_id: Number of the entity there; of a node, the same.
        entity: What it is.
        node: Name of the node.
        namespace: Of the node.
        enclave: Of the node.
        endpoint: What it is the end of; None of a node.
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
        end = self.endpoint
        return "/".join(
            (*head, *node, _mangled(end.topic), dds_type(end.type_name), end.rihs01, qos.to_zenoh(end.qos))
        )


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"
