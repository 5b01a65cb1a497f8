"""Ports and multicast groups by which a capture knows a middleware's packets.

DDS: RTPS 2.5, section 9.6.2 (PB 7400, DG 250, PG 2, d0 0, d1 10, d2 1, d3 11). Zenoh and ROS 1: others than their
usual ones, so that fieldkit's routers, masters and nodes run beside a robot's own; only Zenoh's scouting has its own.
"""

from typing import Final

from fieldkit.core.lazy import dataclass

MASTER: Final = 11399
ZENOH: Final = 7457

_ZENOH_SCOUTING: Final = 7446
ROS1_NODE: Final = {"xmlrpc_port": 11411, "tcpros_port": 11412}
"""Of a node, by the settings of the agent that give it them."""

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


def zenoh(*, multicast: bool) -> MiddlewarePorts:
    """Return Zenoh's ports; what a session declares goes the way of its data."""
    if not multicast:
        return MiddlewarePorts(data=frozenset({ZENOH}), discovery=frozenset())
    return MiddlewarePorts(frozenset({ZENOH}), frozenset({_ZENOH_SCOUTING}), "224.0.0.224")


def ros1() -> MiddlewarePorts:
    """Return the ports of the agent's nodes of ROS 1, and of the master."""
    return MiddlewarePorts(
        data=frozenset({ROS1_NODE["tcpros_port"]}), discovery=frozenset({ROS1_NODE["xmlrpc_port"], MASTER})
    )
