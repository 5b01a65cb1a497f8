"""Plans of flights, which the laptop sends to the programs on a drone, and the orders of the laptop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Mapping, Sequence

from fieldkit.agent.flying.origin import FlightOrigin, Position

STAY, CLIMB, GO, HOME, LEAVE = "stay", "climb", "go", "home", "leave"
"""Orders: wait (`stay`), climb to the height, fly the path (`go`), end the flight as the plan requires and land
(`home`), and stop the program without a command to the drone (`leave`)."""

ON_GROUND, CLIMBING, AT_PATH_START, ON_PATH = "standing", "climbing", "up", "flying"
AT_PATH_END, RETURNING, DESCENDING = "there", "coming back", "coming down"
PHASES = (ON_GROUND, CLIMBING, AT_PATH_START, ON_PATH, AT_PATH_END, RETURNING, DESCENDING)
"""Phases of a flight in chronological order, with their names in logs.

The drone waits on the ground, climbs, waits above the origin for the order to fly, flies the path, waits at its end
for the order to land, returns to the origin if the plan requires it, and descends.
"""

MISPLACED = "misplaced"
"""Log line of a pilot that does not fly because the drone is not at the origin of its trial."""


@dataclass(frozen=True)
class FlightNeeds:
    """Requirements of a flight that an autopilot must meet.

    Attributes:
        highest_m: Maximum height of the flight above the ground at its start.
        farthest_m: Maximum horizontal distance of the flight from its origin.
        ceiling_m: Maximum allowed height above the ground at the start of the flight.
        least_charge: Minimum charge of the battery, from 0 to 1.
        returns: Whether the drone must return automatically if the flight is aborted.
    """

    highest_m: float
    farthest_m: float
    ceiling_m: float
    least_charge: float
    returns: bool


@dataclass(frozen=True)
class FlightPlan:
    """Parameters of a program that controls a drone during a flight.

    The program is the pilot, which flies the drone; the guard, which lands it if the pilot stops; or the rescue
    program, which lands it if both have stopped.

    Attributes:
        connection: Name of the connection to the autopilot; see `mavlink_links.open_link`.
        orders: The file of orders.
        abort: Command if the flight is aborted: `land` or `return`.
        lease_s: Timeout for the first order.
        guards: Whether the program is the guard.
        rescues: Whether the program is the rescue program.
        end: End of the flight: `land` at the current position, or `return` to the origin and land.
        height_m: Height of the take-off.
        legs: The path after the take-off: metres ahead, to the left and up per leg, relative to the origin's heading.
        speed_m_s: Speed along the path.
        climb_m_s: Speed of the take-off.
        ceiling_m: Maximum height above the ground at the start.
        fence_m: Maximum horizontal distance from the origin.
        least_charge: Minimum charge of the battery before the take-off, from 0 to 1.
        origin: Values of the `FlightOrigin` of the trial; None at the first start, which becomes the origin.
        log: The log file of positions; empty to write none.
        liveness: The file that pilot and guard share (`LivenessFile`); empty if only one of them runs.
        landing_marker: A file that exists while the program lands a drone. Meanwhile, fieldkit does not kill it.
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
    landing_marker: str = ""

    @property
    def needs(self) -> FlightNeeds:
        """Requirements of the flight that an autopilot must meet."""
        # The path relative to an origin at zero, on the ground.
        corners_m = self.corners_m(FlightOrigin("", "", 0.0, 0.0, 0.0), 0.0)
        return FlightNeeds(
            highest_m=max(-down_m for _, _, down_m in corners_m),
            farthest_m=max(math.hypot(north_m, east_m) for north_m, east_m, _ in corners_m),
            ceiling_m=self.ceiling_m,
            least_charge=self.least_charge,
            returns=self.abort == "return",
        )

    def corners_m(self, origin: FlightOrigin, ground_m: float) -> list[Position]:
        """Return the corners of the path, the first above the origin.

        Args:
            origin: The origin, in the frame of this flight.
            ground_m: Down coordinate of the ground.
        """
        ahead_m, left_m, down_m = 0.0, 0.0, ground_m - self.height_m
        corners_m = [origin.position_at(ahead_m, left_m, down_m)]
        for ahead, left, up in self.legs:
            ahead_m, left_m, down_m = ahead_m + ahead, left_m + left, down_m - up
            corners_m.append(origin.position_at(ahead_m, left_m, down_m))
        return corners_m


def point_on_path(corners_m: Sequence[Position], distance_m: float) -> Position:
    """Return the point at a distance along a path, or its end if the path is shorter."""
    for leg_start, end in zip(corners_m, corners_m[1:]):
        length_m = math.dist(leg_start, end)
        if distance_m < length_m:
            return _interpolate(leg_start, end, distance_m / length_m)
        distance_m -= length_m
    return corners_m[-1]


def _interpolate(leg_start: Position, end: Position, fraction: float) -> Position:
    north_m, east_m, down_m = (start_m + fraction * (end_m - start_m) for start_m, end_m in zip(leg_start, end))
    return north_m, east_m, down_m
