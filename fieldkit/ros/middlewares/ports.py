"""Ports and multicast groups of middlewares, which identify the packets of a middleware in captures.

DDS: RTPS 2.5, section 9.6.2. A port is 7400 + 250 * domain + 2 * participant + offset; the offset is 0 for multicast
discovery and 1 for multicast data (both without the participant), 10 for unicast discovery and 11 for unicast data.
fieldkit's routers, masters and nodes do not use the default ports of Zenoh and ROS 1, so that they can run on a robot
together with routers, masters and nodes that were started by others. Each domain has separate ports, so that several
domains can be used on one robot. Only Zenoh scouting uses its default port.
"""

from dataclasses import dataclass
from typing import Final

_ZENOH_SCOUTING: Final = 7446
_ZENOH_FIRST: Final = 7500
_ROS1_FIRST: Final = 11500
_ROS1_PORTS: Final = 3

_PARTICIPANTS: Final = 4
"""Number of participants of a domain on a robot whose ports are included: one of fieldkit, and up to three others."""

MAX_DOMAIN: Final = 101
"""Maximum domain: the DDS ports of higher domains are in the ephemeral port range of Linux."""


@dataclass(frozen=True)
class MiddlewarePorts:
    """Ports of a middleware on each robot.

    Attributes:
        data: Ports of samples and their acknowledgements.
        discovery: Ports used for discovery.
        group: Multicast group used for discovery; None without multicast.
    """

    data: frozenset[int]
    discovery: frozenset[int]
    group: str | None = None


def dds(domain: int, *, multicast: bool) -> MiddlewarePorts:
    """Return the ports of a DDS domain; those of unicast for participants 0 to 3 on a robot."""
    base = 7400 + 250 * domain
    numbers = range(_PARTICIPANTS)
    return MiddlewarePorts(
        data=frozenset({base + 1, *(base + 11 + 2 * number for number in numbers)}),
        discovery=frozenset({base, *(base + 10 + 2 * number for number in numbers)}),
        group="239.255.0.1" if multicast else None,
    )


def zenoh_listener(domain: int) -> int:
    """Return the port on which Zenoh sessions and routers listen in a domain."""
    return _ZENOH_FIRST + domain


def zenoh(domain: int, *, multicast: bool) -> MiddlewarePorts:
    """Return Zenoh's ports in a domain; a session sends declarations and data over the same port."""
    data = frozenset({zenoh_listener(domain)})
    if not multicast:
        return MiddlewarePorts(data=data, discovery=frozenset())
    return MiddlewarePorts(data, frozenset({_ZENOH_SCOUTING}), "224.0.0.224")


def ros1_master(domain: int) -> int:
    """Return the port of the ROS 1 master in a domain."""
    return _ROS1_FIRST + _ROS1_PORTS * domain


def ros1_node(domain: int) -> dict[str, int]:
    """Return the ports of the node of fieldkit's agent in a ROS 1 domain, by the name of the agent's setting.

    The agent is the program that fieldkit copies to a robot and runs there. ROS 1 itself has no domains.
    """
    return {"xmlrpc_port": ros1_master(domain) + 1, "tcpros_port": ros1_master(domain) + 2}


def ros1(domain: int) -> MiddlewarePorts:
    """Return the ports of the ROS 1 master and of the agent's nodes in a domain."""
    node = ros1_node(domain)
    return MiddlewarePorts(
        data=frozenset({node["tcpros_port"]}), discovery=frozenset({node["xmlrpc_port"], ros1_master(domain)})
    )
