"""Names of topics, types and nodes on the wire: of ROS 2 over DDS, and of rmw_zenoh.

DDS: "Topic and Service name mapping to DDS" and the mapping of interfaces to IDL, of design.ros2.org.
Zenoh: docs/design.md of github.com/ros2/rmw_zenoh, sections Publishers and Graph Cache, from its version 0.3 on.
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Self

from fieldkit.core.errors import EvidenceError
from fieldkit.ros import qos
from fieldkit.ros.qos import QosProfile

ADMIN_SPACE: Final = "@ros2_lv"
"""With which every liveliness token of rmw_zenoh begins."""

NO_HASH: Final = "TypeHashNotSupported"
"""Stands for the hash of a type where ROS 2 has none: in rmw_zenoh of Humble."""

_TOPIC_PREFIX: Final = "rt"
_DDS_TYPE: Final = re.compile(r"(?P<package>\w+)::(?P<kind>msg|srv|action)::dds_::(?P<name>\w+)_", re.ASCII)
_OF_NODE: Final = 9
_OF_ENDPOINT: Final = 13


def dds_type(name: str) -> str:
    """Return the DDS name of a message type: `sensor_msgs::msg::dds_::LaserScan_`."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(name: str) -> str | None:
    """Return the ROS name of a DDS type, `sensor_msgs/msg/LaserScan`; None where it is no type of ROS."""
    found = _DDS_TYPE.fullmatch(name)
    return found and "/".join(found.group("package", "kind", "name"))


def dds_topic(topic: str) -> str:
    """Return the DDS name of a topic: `rt/scan` of `/scan`."""
    return f"{_TOPIC_PREFIX}/{topic.lstrip('/')}"


def ros_topic(name: str) -> str | None:
    """Return the ROS name of a DDS topic, `/scan`; None where it is no topic of ROS."""
    prefix, slash, rest = name.partition("/")
    return f"/{rest}" if prefix == _TOPIC_PREFIX and slash else None


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
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True)
class Endpoint:
    """A publisher, a subscription, or one end of a service.

    Attributes:
        topic: `/scan`.
        type_name: `sensor_msgs/msg/LaserScan`, or the DDS name of what is no type of ROS.
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
        one = self.endpoint
        known = "/" in one.type_name
        kind = dds_type(one.type_name) if known else one.type_name
        return "/".join((*head, *node, _mangled(one.topic), kind, one.rihs01, qos.to_zenoh(one.qos)))

    @classmethod
    def parse(cls, key: str) -> Self:
        """Return what a key expression tells.

        What newer versions append is passed over.

        Raises:
            EvidenceError: It is no liveliness token.
        """
        parts = key.split("/")
        whole = parts[0] == ADMIN_SPACE and len(parts) >= _OF_NODE and "" not in parts[:_OF_NODE]
        try:
            entity = Entity(parts[5] if whole else "")
            enclave, namespace, node = map(_demangled, parts[6:_OF_NODE])
            endpoint = None
            if entity is not Entity.NODE:
                topic, kind, rihs01, quality = parts[_OF_NODE:_OF_ENDPOINT]
                endpoint = Endpoint(_demangled(topic), ros_type(kind) or kind, rihs01, qos.from_zenoh(quality))
            numbers = int(parts[1]), parts[2], int(parts[3]), int(parts[4])
            return cls(*numbers, entity, node, namespace, enclave, endpoint)
        except ValueError:
            raise EvidenceError(f"{key[:200]!r} is no liveliness token of rmw_zenoh") from None


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def _demangled(name: str) -> str:
    return name.replace("%", "/")
