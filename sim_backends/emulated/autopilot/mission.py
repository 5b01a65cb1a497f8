"""The mission that a vehicle flies: which item it is at, and what that asks for now."""

import math
from collections.abc import Iterator
from itertools import islice, repeat
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.flight import Airframe
from sim_backends.emulated.autopilot.mavlink import dialect
from sim_backends.emulated.autopilot.plan import PASSED, WAITS, Item, goal_m

REPEATS: Final = 10
REPEAT_NS: Final = 1_000_000_000
"""How often, and after how long, it says again that an item is done, the last one: as PX4, for messages are lost."""

_BELOW_M: Final = -1.0
"""Height of a point to land at: the ground stops whoever flies there."""

_RISEN_M: Final = 0.2
"""As near as this below the height of its first item it sets out."""


class Mission:
    """Items in their order.

    Args:
        first: Number of the first that is flown; before it is home, as ArduPilot has it.

    Attributes:
        items: As they were uploaded.
        current: The number of the one that it flies; that of the last, once it is done.
        speed_m_s: The speed over the ground that an item asked for.
    """

    def __init__(self, first: int = 0) -> None:
        self._first = first
        self.items: tuple[Item, ...] = ()
        self.current = 0
        self.speed_m_s: float | None = None
        self._done = False
        self._reached: list[int] = []
        self._again: Iterator[int] = iter(())
        self._again_ns = 0
        self._from_m: Vector | None = None  # where it was when it began the current item
        self._rises = False
        self._arrived_ns: int | None = None

    def load(self, items: tuple[Item, ...]) -> None:
        """Take new items; the first is the current one."""
        self.items, self.speed_m_s = items, None
        self.go_on_at(0)

    def begin(self) -> None:
        """Go on at the current item, from the first if all are done."""
        if self._done:
            self.go_on_at(0)
        self._enter()

    def go_on_at(self, number: int) -> None:
        """Make an item of the mission, or the first of none, the current one."""
        self.current, self._done = max(number, min(self._first, len(self.items) - 1), 0), False
        self._reached, self._again = [], iter(())
        self._enter()

    def reached(self, now_ns: int) -> Iterator[int]:
        """Yield the numbers of the items done that are to be told now; asked with times that never go back."""
        if self._reached:
            yield from self._reached
            self._again, self._again_ns = repeat(self._reached[-1], REPEATS), now_ns + REPEAT_NS
            self._reached = []
        elif now_ns >= self._again_ns:
            yield from islice(self._again, 1)
            self._again_ns = now_ns + REPEAT_NS

    def fly(self, body: Airframe, home_m: Vector, near_m: float) -> Vector | str:
        """Return what to do now: the point to fly to, seen from home, to land below it; or the mode to change to.

        Args:
            body: Where the vehicle is.
            home_m: Where home is in the world.
            near_m: What counts as there, unless the item says.
        """
        while not self._done:
            item = self.items[self.current]
            if item.command == dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                self._next()
                return "RTL"
            if item.command == dialect.MAV_CMD_DO_CHANGE_SPEED:
                self.speed_m_s = item.parameters[1] if item.parameters[1] > 0 else None
            elif item.command not in PASSED:
                if self._from_m is None:
                    self._from_m, self._rises = body.position_m, body.on_ground
                goal = self._goal_m(item, self._from_m, body, home_m, near_m)
                if not self._stayed(item, body, goal, near_m):
                    return goal
            self._next()
        return "LOITER"

    def _goal_m(self, item: Item, begin_m: Vector, body: Airframe, home_m: Vector, near_m: float) -> Vector:
        """Return where an item leads; from the ground straight up first."""
        here_m = body.position_m
        if item.command == dialect.MAV_CMD_NAV_DELAY:
            return begin_m
        goal = goal_m(item.frame, item.x, item.y, item.z, home_m)
        if goal is None or (item.command == dialect.MAV_CMD_NAV_LAND and item.x == item.y == 0):
            goal = begin_m  # a landing without a place; `plan.fault` lets nothing else in
        if item.command == dialect.MAV_CMD_NAV_LAND:
            there = math.dist(goal[:2], here_m[:2]) < near_m or body.on_ground
            return *goal[:2], _BELOW_M if there else begin_m[2]
        self._rises = self._rises and here_m[2] < goal[2] - _RISEN_M
        if self._rises or item.command == dialect.MAV_CMD_NAV_TAKEOFF:
            return *begin_m[:2], goal[2]
        return goal

    def _stayed(self, item: Item, body: Airframe, goal: Vector, near_m: float) -> bool:
        """Whether it was at the goal for as long as the item says."""
        if item.command == dialect.MAV_CMD_NAV_LAND:
            return body.on_ground
        wait_s, radius_m, _, _ = item.parameters
        if item.command == dialect.MAV_CMD_NAV_WAYPOINT and radius_m > 0:
            near_m = radius_m
        if self._arrived_ns is None:
            if self._rises or math.dist(goal, body.position_m) > near_m:
                return False
            self._arrived_ns = body.now_ns
        waits = item.command in WAITS and wait_s > 0
        return not waits or body.now_ns - self._arrived_ns >= wait_s * 1e9

    def _next(self) -> None:
        self._reached.append(self.current)
        if self.current + 1 < len(self.items):
            self.current += 1
        else:
            self._done = True
        self._enter()

    def _enter(self) -> None:
        self._from_m, self._rises, self._arrived_ns = None, False, None
