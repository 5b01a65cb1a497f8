"""Fly a drone for a trial, by set-points, and bring it down when nobody leads it any more.

The laptop gives orders in a file, each with a lease: for how many seconds it holds. An order that is not renewed in
time means that the laptop is gone, and a signal that the job is to end: both bring the drone down, as it was told to
be brought down. An autopilot that nobody sends set-points any more has a fail-safe of its own, so that the drone does
not depend on this program either (PX4: COM_OF_LOSS_T, COM_OBL_RC_ACT).
"""

from __future__ import annotations

import math
import selectors
import sys
import threading
import time
from dataclasses import dataclass
from typing import Callable, Iterator, Sequence, Tuple

from fieldkit.agent.autopilot import ACCEPTED, ARM, LAND, RETURN, AutopilotState
from fieldkit.agent.mavlink_frames import ATTITUDE, LOCAL_POSITION_NED
from fieldkit.agent.mavlink_links import opened
from fieldkit.agent.orders import Orders

STAY, CLIMB, GO, HOME, LEAVE = "stay", "climb", "go", "home", "leave"
"""Orders: wait, rise to the height, fly the way, come down, and end with the drone left as it is."""

RATE_HZ = 10.0
"""How often it leads, looks for orders, and asks to be told where the drone is."""

LAPSED, REFUSED, TAKEN, CALLED_OFF = 4, 5, 6, 7
"""Exit codes: the laptop was gone, the autopilot did not do it, somebody else flies it, it was told to end."""

_BEAT_S = 1.0
_AGAIN_S = 0.4
"""After so long without an answer a command is sent again."""
_ANSWERS_S = 5.0
_NEAR_M = 0.3
_SLOW_M_S = 0.2
_SETTLES_S = 1.0
"""So long set-points come before the mode that follows them (PX4 user guide, offboard mode)."""

Place = Tuple[float, float, float]


class FlightError(Exception):
    """It does not go on; the text is for people.

    Args:
        code: Exit code.
        why: Why.
    """

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


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


class OffboardPilot:
    """Flies one drone.

    Args:
        plan: What it flies.
        over: Set when it is to end.
    """

    def __init__(self, plan: FlightPlan, over: threading.Event) -> None:
        self._plan = plan
        self._over = over
        self._link = opened(plan.connection)
        self._drone = AutopilotState(self._link, 0)
        self._orders = Orders(plan.orders, (STAY, CLIMB, GO, HOME, LEAVE), plan.lease_s)
        self._waiting = selectors.DefaultSelector()
        self._waiting.register(self._link.fileno(), selectors.EVENT_READ)
        self._beat_s = 0.0
        self._followed = False

    def fly(self) -> None:
        """Fly, as the orders come.

        Raises:
            FlightError: It ended otherwise; the drone was brought down, where that was possible.
        """
        try:
            self._flown()
        except FlightError as error:
            # What it does not lead is somebody else's, unless it was to watch that.
            if error.code != TAKEN and (self._followed or not self._plan.height_m):
                _say(f"{self._plan.abort}: {error}")
                self._down(self._plan.abort)
                _say("landed")
            raise

    def _flown(self) -> None:
        plan, drone = self._plan, self._drone
        _say(f"waiting for the heartbeat of an autopilot at {plan.connection}")
        self._until(lambda: drone.alive)
        _say("ready")
        if not plan.height_m:
            self._until(lambda: self._orders.order == LEAVE)
            return
        begin_m, yaw_rad = self._stands()
        _say("standing")
        self._until(lambda: self._orders.order in (CLIMB, HOME))
        corners_m = plan.corners_m(begin_m, yaw_rad)
        if self._orders.order == CLIMB:
            self._rise(begin_m, corners_m[0])
            self._go(corners_m)
            if plan.end == "return":
                self._back(begin_m)
        _say("coming down")
        self._down("land")
        _say("landed")

    def _stands(self) -> tuple[Place, float]:
        """Return where it stands, once it says so, and where its nose points."""
        drone = self._drone
        if not drone.px4:
            raise FlightError(REFUSED, "its autopilot is none that is flown by set-points: PX4 alone is")
        asked_s = 0.0
        if drone.armed:
            _say("waiting until its motors stand: somebody flies it, or it is coming down")
        for _ in self._turns():
            if not drone.armed and drone.place_m is not None and drone.yaw_rad is not None:
                return drone.place_m, drone.yaw_rad
            if time.monotonic() > asked_s:
                asked_s = time.monotonic() + 1.0
                drone.ask_for(LOCAL_POSITION_NED, RATE_HZ)
                drone.ask_for(ATTITUDE, RATE_HZ)
        raise AssertionError("turns end by errors alone")

    def _rise(self, begin_m: Place, top_m: Place) -> None:
        """Arm it, and rise straight to the first point of its way."""
        drone, began_s = self._drone, time.monotonic()
        self._until(lambda: time.monotonic() - began_s > _SETTLES_S, lead=lambda: begin_m)
        self._ask(drone.go_offboard, lambda: drone.offboard, "the mode OFFBOARD", begin_m)
        self._followed = True
        self._ask(lambda: drone.command(ARM, 1), lambda: drone.armed, "to arm", begin_m)
        _say("climbing")
        began_s = time.monotonic()
        height_m = begin_m[2] - top_m[2]

        def goal() -> Place:
            return _between(begin_m, top_m, min((time.monotonic() - began_s) * self._plan.climb_m_s / height_m, 1.0))

        self._until(lambda: _near(drone.place_m, top_m) or self._orders.order == HOME, lead=goal)
        _say("up")
        self._until(lambda: self._orders.order in (GO, HOME), lead=lambda: top_m)

    def _go(self, corners_m: Sequence[Place]) -> None:
        """Fly the way, and wait at its end."""
        began_s, said = time.monotonic(), False
        if self._orders.order == GO:
            _say("flying")
        for _ in self._turns(lambda: along(corners_m, (time.monotonic() - began_s) * self._plan.speed_m_s)):
            if self._orders.order == HOME:
                return
            if not said and _near(self._drone.place_m, corners_m[-1]):
                said = True
                _say("there")

    def _back(self, begin_m: Place) -> None:
        """Fly to above where it rose."""
        here_m = self._drone.place_m
        if here_m is None:
            raise FlightError(REFUSED, "the autopilot does not say any more where it is")
        above_m, began_s = (begin_m[0], begin_m[1], here_m[2]), time.monotonic()
        way_m = [here_m, above_m]
        _say("coming back")
        self._until(
            lambda: _near(self._drone.place_m, above_m) and self._drone.speed_m_s < _SLOW_M_S,
            lead=lambda: along(way_m, (time.monotonic() - began_s) * self._plan.speed_m_s),
        )

    def _down(self, how: str) -> None:
        """Bring it down, and wait until its motors stand.

        Raises:
            FlightError: The autopilot is silent: nobody knows what became of it.
        """
        drone, asked_s = self._drone, 0.0
        command = RETURN if how == "return" else LAND
        drone.answers.pop(command, None)
        while drone.armed:
            if not drone.alive:
                raise FlightError(REFUSED, "the autopilot is silent; it was told to land")
            if drone.answers.get(command) != ACCEPTED and time.monotonic() > asked_s:
                asked_s = time.monotonic() + _AGAIN_S
                drone.command(command)
                if command in drone.answers:
                    drone.command(ARM, 0)  # it stands on the ground, and so does not land; in the air it refuses this
            self._turn()

    def _ask(self, ask: Callable[[], None], done: Callable[[], bool], what: str, place_m: Place) -> None:
        """Ask for something until it is so.

        Raises:
            FlightError: It did not become so; says what the autopilot said.
        """
        began_s, asked_s = time.monotonic(), 0.0
        for _ in self._turns(lambda: place_m):
            if done():
                return
            if time.monotonic() > began_s + _ANSWERS_S:
                why = self._drone.said or "it does not say why"
                raise FlightError(REFUSED, f"the autopilot refuses {what}: {why}")
            if time.monotonic() > asked_s:
                asked_s = time.monotonic() + _AGAIN_S
                ask()

    def _until(self, holds: Callable[[], bool], lead: Callable[[], Place] | None = None) -> None:
        for _ in self._turns(lead):
            if holds():
                return

    def _turns(self, lead: Callable[[], Place] | None = None) -> Iterator[None]:
        """Yield ten times a second; lead the drone meanwhile.

        Raises:
            FlightError: Nobody leads this program any more, or somebody else flies the drone.
        """
        while True:
            if self._over.is_set():
                raise FlightError(CALLED_OFF, "the job was told to end")
            self._orders.look()
            if self._orders.lapsed:
                raise FlightError(LAPSED, "nobody has renewed the order in time: the laptop is gone")
            if self._followed and self._drone.alive and not self._drone.offboard:
                raise FlightError(TAKEN, f"somebody else flies it: {self._drone.said or 'it left the mode OFFBOARD'}")
            if lead is not None:
                self._drone.lead(lead())
            self._turn()
            yield

    def _turn(self) -> None:
        """Hear and speak for a tenth of a second."""
        end_s = time.monotonic() + 1 / RATE_HZ
        if time.monotonic() > self._beat_s:
            self._beat_s = time.monotonic() + _BEAT_S
            self._drone.beat()
        while (left_s := end_s - time.monotonic()) > 0:
            if self._waiting.select(left_s):
                self._drone.receive()


def fly(plan: FlightPlan, over: threading.Event) -> int:
    """Fly a drone until the orders end, or `over` is set; return the exit code.

    Raises:
        OSError: The connection cannot be opened, or has ended.
    """
    try:
        OffboardPilot(plan, over).fly()
    except FlightError as error:
        _say(f"error: {error}")
        return error.code
    return 0


def _near(place_m: Place | None, goal_m: Place) -> bool:
    return place_m is not None and math.dist(place_m, goal_m) < _NEAR_M


def _say(text: str) -> None:
    sys.stderr.write(f"{time.time():.3f} {text}\n")
    sys.stderr.flush()
