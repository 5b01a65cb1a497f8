"""Where the robots of a placement stand."""

from collections.abc import Mapping

from fieldkit.model import Placement, Role, Topology

Position = tuple[float, float, float]
"""Metres east, north, up."""


def positions_m(placement: Placement) -> Mapping[Role, Position]:
    """Return where each role stands, in metres east, north, up.

    Master: the relay at the origin, the stations on opposite sides of it, each the distance away. Masterless: the
    sender at the origin, the receiver the distance east of it; a relay takes no part.
    """
    distance_m = placement.distance.metres
    if placement.topology is Topology.MASTER:
        return {
            Role.RELAY: (0.0, 0.0, 0.0),
            Role.SENDER: (-distance_m, 0.0, 0.0),
            Role.RECEIVER: (distance_m, 0.0, 0.0),
        }
    return {Role.SENDER: (0.0, 0.0, 0.0), Role.RECEIVER: (distance_m, 0.0, 0.0)}
