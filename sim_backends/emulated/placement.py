"""Where the robots of a trial stand in the emulated world."""

from fieldkit.backends import Cast
from fieldkit.model import Placement, Role, Scenario, Topology
from sim_backends.radio.links import Position


def positions_m(cast: Cast, placement: Placement) -> dict[str, Position]:
    """Return each robot's place in metres east, north, up.

    Master: the relay at the origin, the stations on opposite sides of it, each the distance away. Masterless: the
    sender at the origin, the receiver the distance east of it; a relay takes no part.
    """
    distance_m = placement.distance.metres
    if placement.topology is Topology.MASTER:
        places = {
            Role.RELAY: (0.0, 0.0, 0.0),
            Role.SENDER: (-distance_m, 0.0, 0.0),
            Role.RECEIVER: (distance_m, 0.0, 0.0),
        }
    else:
        places = {Role.SENDER: (0.0, 0.0, 0.0), Role.RECEIVER: (distance_m, 0.0, 0.0)}
    return {robot.name: places[role] for role, robot in cast.items() if role in places}


def behind_wall(cast: Cast, placement: Placement) -> frozenset[str]:
    """Return the robots behind the wall: without line of sight, the sender (paper, section VI-A)."""
    return frozenset({cast[Role.SENDER].name}) if placement.scenario is Scenario.NLOS else frozenset()


def relay(cast: Cast, placement: Placement) -> str | None:
    """Return the robot whose access point carries the traffic, None where robots talk directly."""
    return cast[Role.RELAY].name if placement.topology is Topology.MASTER else None
