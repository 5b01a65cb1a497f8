"""Plans of flights, as the laptop sends them to the program that flies a drone, and the words of its orders."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Sequence, Tuple

STAY, CLIMB, GO, HOME, LEAVE = "stay", "climb", "go", "home", "leave"
"""Orders: wait, rise to the height, fly the way, come down, and end with the drone left as it is."""

Place = Tuple[float, float, float]
"""North, east, down, in metres."""


@dataclass(frozen=True)
class FlightNeeds:
    """What a flight asks of an autopilot.

    Attributes:
        highest_m: How high it flies, over where it stands.
        farthest_m: How far from where it rises.
        ceiling_m: How high it may fly.
        least_charge: What must be left in its battery, of 1.
        returns: Whether it is to return by itself where the flight is cut short.
    """

    highest_m: float
    farthest_m: float
    ceiling_m: float
    least_charge: float
    returns: bool


@dataclass(frozen=True)
class FlightPlan:
    """What is flown.

    Attributes:
        connection: Where the autopilot is, as `mavlink_links.opened` takes it.
        orders: The file of orders.
        abort: How it is brought down: `land` or `return`.
        lease_s: For how long it waits for the first order.
        end: Where it comes down at the end: `land` where it is, `return` where it rose, at the height it has.
        height_m: To which height it rises first; 0 for one that is watched, and not flown.
        legs: The way then, piece by piece: metres ahead, to the left and up, as its nose points before it rises.
        speed_m_s: How fast, along all of it.
        climb_m_s: How fast it rises.
        ceiling_m: How high it may fly.
        least_charge: What its battery must have before it rises, of 1.
        log: The file in which it writes down where it is; empty for none.
        unhurried: File that is there while it brings down a drone that is no longer to fly: nobody kills it then.
    """

    connection: str
    orders: str
    abort: str
    lease_s: float
    end: str = "land"
    height_m: float = 0.0
    legs: Sequence[Sequence[float]] = ()
    speed_m_s: float = 1.0
    climb_m_s: float = 1.0
    ceiling_m: float = 0.0
    least_charge: float = 0.0
    log: str = ""
    unhurried: str = ""

    @property
    def needs(self) -> FlightNeeds:
        """What it asks of an autopilot."""
        corners_m = self.corners_m((0.0, 0.0, 0.0), 0.0)
        return FlightNeeds(
            highest_m=max(-down_m for _, _, down_m in corners_m),
            farthest_m=max(math.hypot(north_m, east_m) for north_m, east_m, _ in corners_m),
            ceiling_m=self.ceiling_m,
            least_charge=self.least_charge,
            returns=self.abort == "return",
        )

    def corners_m(self, begin_m: Place, yaw_rad: float) -> list[Place]:
        """Return the points between which it flies, north, east, down, from where it has risen on."""
        north, east, down = begin_m[0], begin_m[1], begin_m[2] - self.height_m
        found = [(north, east, down)]
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        for ahead, left, up in self.legs:
            north, east, down = north + ahead * cos + left * sin, east + ahead * sin - left * cos, down - up
            found.append((north, east, down))
        return found


def along(corners_m: Sequence[Place], way_m: float) -> Place:
    """Return the point so far along a way; its end beyond that."""
    for begin, end in zip(corners_m, corners_m[1:]):
        long_m = math.dist(begin, end)
        if way_m < long_m:
            return _between(begin, end, way_m / long_m)
        way_m -= long_m
    return corners_m[-1]


def _between(begin: Place, end: Place, share: float) -> Place:
    n, e, d = (b + share * (a - b) for b, a in zip(begin, end))
    return n, e, d
