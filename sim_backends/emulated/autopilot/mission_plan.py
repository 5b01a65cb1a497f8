"""The mission of an emulated drone: the uploaded items, the current item, and the goal of this item."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, repeat
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.fence import is_within
from sim_backends.emulated.autopilot.flight import Airframe
from sim_backends.emulated.autopilot.mavlink_frames import Message, dialect
from sim_backends.emulated.ros.messages import EAST_RADIUS_M, NORTH_RADIUS_M

MAX_ITEMS: Final = 500
"""Maximum number of items of a mission."""

WITH_HOLD_TIME: Final = frozenset(
    {dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_LOITER_TIME, dialect.MAV_CMD_NAV_DELAY}
)
"""Commands whose first parameter is the time to stay in seconds."""
WITH_POSITION: Final = frozenset(
    {
        dialect.MAV_CMD_NAV_WAYPOINT,
        dialect.MAV_CMD_NAV_LOITER_TIME,
        dialect.MAV_CMD_NAV_TAKEOFF,
        dialect.MAV_CMD_NAV_LAND,
    }
)
"""Commands whose goal is a position."""
SUPPORTED: Final = (
    WITH_HOLD_TIME | WITH_POSITION | {dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH, dialect.MAV_CMD_DO_CHANGE_SPEED}
)
"""Commands that the vehicle executes in a mission."""
SKIPPED: Final = frozenset(
    {
        dialect.MAV_CMD_DO_MOUNT_CONTROL,
        dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
        dialect.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
    }
)
"""Commands for gimbals, which ground stations add to every plan; the drone has no gimbal and skips them."""

_ABOVE_HOME: Final = (dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT, dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
_ABOVE_SEA: Final = (dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_GLOBAL_INT)


@dataclass(frozen=True)
class Item:
    """One item, as in MISSION_ITEM_INT.

    Attributes:
        frame: MAV_FRAME of the position.
        command: MAV_CMD of the action.
        parameters: First four parameters of the command.
        x: Latitude, 1e-7 degrees.
        y: Longitude, 1e-7 degrees.
        z: Height in metres above the reference of the frame.
        autocontinue: The field `autocontinue` as received.
    """

    frame: int
    command: int
    parameters: tuple[float, float, float, float]
    x: int
    y: int
    z: float
    autocontinue: int = 1


def item_of(message: Message) -> Item:
    """Return the item of a MISSION_ITEM_INT."""
    parameters = (message.param1, message.param2, message.param3, message.param4)
    return Item(message.frame, message.command, parameters, message.x, message.y, message.z, message.autocontinue)


def goal_m(frame: int, x: int, y: int, z: float, home_m: Vector) -> Vector | None:
    """Return a position of MAVLink in metres east, north, up of home; None for a frame that is not supported."""
    if frame not in _ABOVE_HOME + _ABOVE_SEA or not math.isfinite(z):
        return None
    east_m, north_m = world_m(x, y)
    up_m = z - (home_m[2] if frame in _ABOVE_SEA else 0.0)
    return east_m - home_m[0], north_m - home_m[1], up_m


def world_m(latitude_e7: int, longitude_e7: int) -> tuple[float, float]:
    """Return a position in the world, metres east and north of its origin."""
    return math.radians(longitude_e7 / 1e7) * EAST_RADIUS_M, math.radians(latitude_e7 / 1e7) * NORTH_RADIUS_M


def degrees_e7(east_m: float, north_m: float) -> tuple[int, int]:
    """Return latitude and longitude of a position in the world, 1e-7 degrees; the inverse of `world_m`."""
    latitude, longitude = math.degrees(north_m / NORTH_RADIUS_M), math.degrees(east_m / EAST_RADIUS_M)
    return round(latitude * 1e7), round(longitude * 1e7)


def fault(item: Item, home_m: Vector, fence_m: tuple[float, float]) -> int:
    """Return the fault of an item as MAV_MISSION_RESULT; ACCEPTED if it has none.

    Args:
        item: The item.
        home_m: Home in the world.
        fence_m: Maximum horizontal distance from home, and maximum height.
    """
    if item.command not in SUPPORTED | SKIPPED:
        return int(dialect.MAV_MISSION_UNSUPPORTED)
    has_no_position = item.command == dialect.MAV_CMD_NAV_LAND and item.x == item.y == 0
    if item.command not in WITH_POSITION or has_no_position:
        return int(dialect.MAV_MISSION_ACCEPTED)
    goal = goal_m(item.frame, item.x, item.y, item.z, home_m)
    if goal is None:
        return int(dialect.MAV_MISSION_UNSUPPORTED_FRAME)
    if item.command == dialect.MAV_CMD_NAV_TAKEOFF:  # A take-off climbs vertically.
        goal = (0.0, 0.0, goal[2])
    inside = is_within(goal, fence_m)
    return int(dialect.MAV_MISSION_ACCEPTED if inside else dialect.MAV_MISSION_DENIED)


REPEATS: Final = 10
REPEAT_NS: Final = 1_000_000_000
"""The report of the last completed item is repeated this many times at this interval, as in PX4, because messages may
be lost."""

_LANDING_HEIGHT_M: Final = -1.0
"""Height of the goal of a landing. It is below the ground, so that the drone descends until the ground stops it."""

_CLIMB_TOLERANCE_M: Final = 0.2
"""The vertical climb from the ground ends when the drone is at most this far below the height of the item."""


class Mission:
    """The items of a mission, in their order.

    Args:
        first: Number of the first item that the vehicle executes; ArduPilot's item 0 is home.

    Attributes:
        items: The items as uploaded.
        current: Number of the current item; after the end, the number of the last item.
        speed_m_s: Ground speed that an item has set; None if no item has set one.
    """

    def __init__(self, first: int = 0) -> None:
        self._first = first
        self.items: tuple[Item, ...] = ()
        self.current = 0
        self.speed_m_s: float | None = None
        self._is_finished = False
        self._reached_items: list[int] = []
        self._repeated_reports: Iterator[int] = iter(())
        self._next_repeat_ns = 0
        self._start_m: Vector | None = None  # position at the start of the current item
        self._is_climbing = False
        self._arrived_ns: int | None = None

    def load(self, items: tuple[Item, ...]) -> None:
        """Load new items; the first that the vehicle executes is the current one."""
        self.items, self.speed_m_s = items, None
        self.set_current(0)

    def start(self) -> None:
        """Continue at the current item, or start at the first if all are done."""
        if self._is_finished:
            self.set_current(0)
        self._reset_item_state()

    def set_current(self, number: int) -> None:
        """Make an item the current item: the item with this number, or the first item if the number is lower."""
        self.current, self._is_finished = max(number, min(self._first, len(self.items) - 1), 0), False
        self._reached_items, self._repeated_reports = [], iter(())
        self._reset_item_state()

    def reached_items(self, now_ns: int) -> Iterator[int]:
        """Yield the numbers of completed items that must be reported now; times must not decrease."""
        if self._reached_items:
            yield from self._reached_items
            self._repeated_reports, self._next_repeat_ns = (
                repeat(self._reached_items[-1], REPEATS),
                now_ns + REPEAT_NS,
            )
            self._reached_items = []
        elif now_ns >= self._next_repeat_ns:
            yield from islice(self._repeated_reports, 1)
            self._next_repeat_ns = now_ns + REPEAT_NS

    def next_goal_or_mode(self, body: Airframe, home_m: Vector, near_m: float, *, has_landed: bool) -> Vector | str:
        """Return the point to fly to, or the name of the mode to change to: `RTL`, or `LOITER` after the last item.

        The point is relative to home. A point below home means landing.

        Args:
            body: State of motion of the vehicle.
            home_m: Home in the world.
            near_m: Radius within which a point is reached, unless the item defines a radius.
            has_landed: True if the vehicle has detected that it is on the ground. A first contact does not complete a
                landing, because the vehicle may bounce.
        """
        while not self._is_finished:
            item = self.items[self.current]
            if item.command == dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                self._next()
                return "RTL"
            if item.command == dialect.MAV_CMD_DO_CHANGE_SPEED:
                self.speed_m_s = item.parameters[1] if item.parameters[1] > 0 else None
            elif item.command not in SKIPPED:
                if self._start_m is None:
                    self._start_m, self._is_climbing = body.position_m, body.on_ground
                goal = self._goal_m(item, self._start_m, body, home_m, near_m)
                is_landing = item.command == dialect.MAV_CMD_NAV_LAND
                if not (has_landed if is_landing else self._is_complete(item, body, goal, near_m)):
                    return goal
            self._next()
        return "LOITER"

    def _goal_m(self, item: Item, start_m: Vector, body: Airframe, home_m: Vector, near_m: float) -> Vector:
        """Return the goal of an item; a vehicle on the ground first climbs vertically."""
        here_m = body.position_m
        if item.command == dialect.MAV_CMD_NAV_DELAY:
            return start_m
        goal = goal_m(item.frame, item.x, item.y, item.z, home_m)
        if goal is None or (item.command == dialect.MAV_CMD_NAV_LAND and item.x == item.y == 0):
            goal = start_m  # a landing without a position; `fault` rejects all other items without one
        if item.command == dialect.MAV_CMD_NAV_LAND:
            is_above = math.dist(goal[:2], here_m[:2]) < near_m or body.on_ground
            return *goal[:2], _LANDING_HEIGHT_M if is_above else start_m[2]
        self._is_climbing = self._is_climbing and here_m[2] < goal[2] - _CLIMB_TOLERANCE_M
        if self._is_climbing or item.command == dialect.MAV_CMD_NAV_TAKEOFF:
            return *start_m[:2], goal[2]
        return goal

    def _is_complete(self, item: Item, body: Airframe, goal: Vector, near_m: float) -> bool:
        """Return True if the vehicle has been at the goal for as long as the item requires."""
        wait_s, radius_m, _, _ = item.parameters
        if item.command == dialect.MAV_CMD_NAV_WAYPOINT and radius_m > 0:
            near_m = radius_m
        if self._arrived_ns is None:
            if self._is_climbing or math.dist(goal, body.position_m) > near_m:
                return False
            self._arrived_ns = body.now_ns
        must_wait = item.command in WITH_HOLD_TIME and wait_s > 0
        return not must_wait or body.now_ns - self._arrived_ns >= wait_s * 1e9

    def _next(self) -> None:
        self._reached_items.append(self.current)
        if self.current + 1 < len(self.items):
            self.current += 1
        else:
            self._is_finished = True
        self._reset_item_state()

    def _reset_item_state(self) -> None:
        self._start_m, self._is_climbing, self._arrived_ns = None, False, None
