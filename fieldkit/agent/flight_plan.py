"""Plans of flights, as the laptop sends them to the programs on a drone, and the words of its orders."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Mapping, Sequence

from fieldkit.agent.flying.origin import FlightOrigin, Place

STAY, CLIMB, GO, HOME, LEAVE = "stay", "climb", "go", "home", "leave"
"""Orders: wait, rise to the height, fly the way, come down, and end with the drone left as it is."""


MISPLACED = "misplaced"
"""Line in the log of a pilot that does not fly because the drone is not at the origin of its trial."""


@dataclass(frozen=True)
class FlightNeeds:
    """What a flight requires of an autopilot.

    Attributes:
        highest_m: Its largest height over the ground where it starts.
        farthest_m: Its largest distance from its origin, over the ground.
        ceiling_m: The largest height that is allowed.
        least_charge: The charge that its battery must have, of 1.
        returns: Whether it is to return by itself where the flight is cut short.
    """

    highest_m: float
    farthest_m: float
    ceiling_m: float
    least_charge: float
    returns: bool


@dataclass(frozen=True)
class FlightPlan:
    """A flight, or the guarding of one.

    Attributes:
        connection: Where the autopilot is, as `mavlink_links.opened` takes it.
        orders: The file of orders.
        abort: How the drone is brought down where the flight is cut short: `land` or `return`.
        lease_s: For how long the first order is awaited.
        guards: Whether the program guards the drone, and does not fly it.
        rescues: Whether it only brings the drone down, because neither its pilot nor its guard runs.
        end: Where it comes down at the end: `land` where it is, `return` above its origin, at the height it has.
        height_m: To which height it rises first.
        legs: The way then, piece by piece: metres ahead, to the left and up, by the heading of the origin.
        speed_m_s: Its speed along the way.
        climb_m_s: Its speed while it rises.
        ceiling_m: The largest height at which it may fly, over the ground where it starts.
        fence_m: The largest distance from the origin at which it may fly.
        least_charge: The charge that its battery must have before it rises, of 1.
        origin: Values of the `FlightOrigin` of the trial; None at the first start, which becomes the origin.
        log: The file of its positions; empty for none.
        liveness: The file that pilot and guard share (`LivenessFile`); empty where only one of them runs.
        unhurried: File that exists while the program brings a drone down: it is not killed then.
    """

    connection: str
    orders: str
    abort: str
    lease_s: float
    guards: bool = False
    rescues: bool = False
    end: str = "land"
    height_m: float = 0.0
    legs: Sequence[Sequence[float]] = ()
    speed_m_s: float = 1.0
    climb_m_s: float = 1.0
    ceiling_m: float = 0.0
    fence_m: float = 0.0
    least_charge: float = 0.0
    origin: Mapping[str, Any] | None = None
    log: str = ""
    liveness: str = ""
    unhurried: str = ""

    @property
    def needs(self) -> FlightNeeds:
        """What it requires of an autopilot."""
        corners_m = self.corners_m(FlightOrigin("", "", 0.0, 0.0, 0.0), 0.0)
        return FlightNeeds(
            highest_m=max(-down_m for _, _, down_m in corners_m),
            farthest_m=max(math.hypot(north_m, east_m) for north_m, east_m, _ in corners_m),
            ceiling_m=self.ceiling_m,
            least_charge=self.least_charge,
            returns=self.abort == "return",
        )

    def corners_m(self, origin: FlightOrigin, ground_m: float) -> list[Place]:
        """Return the points between which it flies, the first above the origin.

        Args:
            origin: The origin, in the frame of this flight.
            ground_m: Position of the ground, down.
        """
        ahead_m, left_m, down_m = 0.0, 0.0, ground_m - self.height_m
        corners_m = [origin.at(ahead_m, left_m, down_m)]
        for ahead, left, up in self.legs:
            ahead_m, left_m, down_m = ahead_m + ahead, left_m + left, down_m - up
            corners_m.append(origin.at(ahead_m, left_m, down_m))
        return corners_m


def along(corners_m: Sequence[Place], way_m: float) -> Place:
    """Return the point at a distance along a way; its end beyond that."""
    for begin, end in zip(corners_m, corners_m[1:]):
        long_m = math.dist(begin, end)
        if way_m < long_m:
            return _between(begin, end, way_m / long_m)
        way_m -= long_m
    return corners_m[-1]


def _between(begin: Place, end: Place, share: float) -> Place:
    n, e, d = (b + share * (a - b) for b, a in zip(begin, end))
    return n, e, d
