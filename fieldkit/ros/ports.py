"""Ports and multicast groups by which a capture knows a middleware's packets.

DDS: RTPS 2.5, section 9.6.2 (PB 7400, DG 250, PG 2, d0 0, d1 10, d2 1, d3 11). Zenoh and ROS 1: others than their
usual ones, so that fieldkit's routers, masters and nodes run beside a robot's own, and others in every domain, so
that several run on one robot; only Zenoh's scouting has its own.
"""

from dataclasses import dataclass
from typing import Final

_ZENOH_SCOUTING: Final = 7446
_ZENOH_FIRST: Final = 7500
_ROS1_FIRST: Final = 11500
_ROS1_EACH: Final = 3

_PARTICIPANTS: Final = 4
"""Of one domain on one robot: more than one of fieldkit's and some of the robot's own."""

MOST_DOMAIN: Final = 101
"""Above it ports of DDS are those that Linux gives to anybody."""


@dataclass(frozen=True)
class MiddlewarePorts:
    """Ports of a middleware on every robot.

    Attributes:
        data: Of samples and their acknowledgements.
        discovery: By which ends look for each other.
        group: Multicast group that is asked; None where nobody is.
    """

    data: frozenset[int]
    discovery: frozenset[int]
    group: str | None = None


def dds(domain: int, *, multicast: bool) -> MiddlewarePorts:
    """Return the ports of a DDS domain."""
    base = 7400 + 250 * domain
    numbers = range(_PARTICIPANTS)
    return MiddlewarePorts(
        data=frozenset({base + 1, *(base + 11 + 2 * number for number in numbers)}),
        discovery=frozenset({base, *(base + 10 + 2 * number for number in numbers)}),
        group="239.255.0.1" if multicast else None,
    )


def zenoh_listener(domain: int) -> int:
    """Return the port on which sessions and routers of Zenoh listen in a domain."""
    return _ZENOH_FIRST + domain


def zenoh(domain: int, *, multicast: bool) -> MiddlewarePorts:
    """Return Zenoh's ports in a domain; what a session declares goes the way of its data."""
    data = frozenset({zenoh_listener(domain)})
    if not multicast:
        return MiddlewarePorts(data=data, discovery=frozenset())
    return MiddlewarePorts(data, frozenset({_ZENOH_SCOUTING}), "224.0.0.224")


def ros1_master(domain: int) -> int:
    """Return the port of ROS 1's master in a domain."""
    return _ROS1_FIRST + _ROS1_EACH * domain


def ros1_node(domain: int) -> dict[str, int]:
    """Return the ports of a node of ROS 1, by the settings of the agent that give it them."""
    return {"xmlrpc_port": ros1_master(domain) + 1, "tcpros_port": ros1_master(domain) + 2}


def ros1(domain: int) -> MiddlewarePorts:
    """Return the ports of the agent's nodes of ROS 1 in a domain, and of the master."""
    node = ros1_node(domain)
    return MiddlewarePorts(
        data=frozenset({node["tcpros_port"]}), discovery=frozenset({node["xmlrpc_port"], ros1_master(domain)})
    )
