"""The loop of a pilot: ten turns a second, each with what must hold for a flight to go on."""

from __future__ import annotations

import threading
import time
from typing import Callable, Iterator

from fieldkit.agent.autopilot import AutopilotState
from fieldkit.agent.flight_plan import CLIMB, GO, HOME, LEAVE, STAY, FlightPlan
from fieldkit.agent.flying.liveness import FLYING, IDLE, LANDING, PILOT, LivenessFile
from fieldkit.agent.flying.origin import FlightFence, FlightOrigin, Place
from fieldkit.agent.flying.talk import AutopilotTalk
from fieldkit.agent.landing import (
    AGAIN_S,
    ANSWERS_S,
    CALLED_OFF,
    FENCED,
    GONE,
    LAPSED,
    REFUSED,
    TAKEN,
    FlightError,
    say,
)
from fieldkit.agent.mavlink_frames import ATTITUDE, GLOBAL_POSITION_INT, HEARTBEAT, LOCAL_POSITION_NED
from fieldkit.agent.orders import Orders

RATE_HZ = 10.0
"""Rate of turns, of set-points, and of the reports that are requested."""
GAP_S = 1.0
"""After a longer time between two turns, as by SIGSTOP, a program does not lead its drone any more."""
HEARTBEAT_S = 6.0
"""An autopilot that is not heard in this time is not there."""

_SILENT_S = 10.0
"""A drone is led for this long without a heartbeat: the connection may come back."""
_BLIND_S = 5.0
"""And for this long without a report of its position, which is requested again and again meanwhile."""
_STREAMS = (HEARTBEAT, LOCAL_POSITION_NED, ATTITUDE)


class FlightLoop:
    """Turns of a program that leads a drone.

    Args:
        plan: The flight.
        over: Set when the job is to end.
        note: Called at the end of each turn, with the state of the autopilot.

    Attributes:
        talk: The conversation with the autopilot.
        drone: Its state.
        orders: The orders of the laptop; their lease begins when the autopilot has been heard.
        state: What the program does, for its guard.
        yaw_rad: The heading of all set-points.
        fence: The fence; None before the origin is known.
        rose: Whether the motors were armed for this flight.

    Raises:
        OSError: The connection cannot be opened.
    """

    def __init__(self, plan: FlightPlan, over: threading.Event, note: Callable[[AutopilotState], None]) -> None:
        self._plan = plan
        self._over = over
        self._liveness = LivenessFile(plan.liveness, PILOT) if plan.liveness else None
        self.talk = AutopilotTalk(plan.connection, note)
        self.drone = self.talk.drone
        self.orders = Orders(plan.orders, (STAY, CLIMB, GO, HOME, LEAVE), plan.lease_s)
        self.state = IDLE
        self.yaw_rad = 0.0
        self.fence: FlightFence | None = None
        self.rose = False
        self._turned_s: float | None = None
        self._mode_name = ""

    def begin(self, origin: FlightOrigin, ground_m: float) -> None:
        """Take the origin: the heading of all set-points, and the centre of the fence."""
        self.yaw_rad = origin.heading_rad
        self.fence = FlightFence(origin, ground_m, self._plan.fence_m, self._plan.ceiling_m)

    def wait_for_autopilot(self) -> None:
        """Wait for its first heartbeat, and request its reports.

        Raises:
            FlightError: It is not heard, or the job was ended.
        """
        began_s = time.monotonic()
        while not self.drone.alive:
            if self._over.is_set():
                raise FlightError(CALLED_OFF, "the job was ended")
            if time.monotonic() > began_s + HEARTBEAT_S:
                where = self._plan.connection
                raise FlightError(REFUSED, f"no heartbeat of an autopilot at {where} in {HEARTBEAT_S:g} s")
            self.beat()
            self.talk.turn(1 / RATE_HZ)
        for kind in _STREAMS:
            self.drone.request_stream(kind, RATE_HZ)
        self.drone.request_stream(GLOBAL_POSITION_INT, 2.0)
        self.orders = Orders(self._plan.orders, (STAY, CLIMB, GO, HOME, LEAVE), self._plan.lease_s)

    def beat(self) -> None:
        """Show the guard that this program runs, and report texts and modes of the autopilot that are new."""
        if self._liveness is not None:
            self._liveness.beat(self.state)
        for text in self.drone.texts.new():
            say(f"the autopilot: {text}")
        if self.drone.dialect is not None and self.drone.mode_name != self._mode_name:
            self._mode_name = self.drone.mode_name
            say(f"mode {self._mode_name}")

    def turns(self, lead: Callable[[], Place] | None = None) -> Iterator[None]:
        """Yield ten times a second; send set-points meanwhile, all of them inside the fence.

        Raises:
            FlightError: The flight does not go on.
        """
        self._turned_s = None
        while True:
            self._demand_own_time()
            if self._over.is_set():
                raise FlightError(CALLED_OFF, "the job was ended")
            self.orders.look()
            if self.orders.lapsed:
                raise FlightError(LAPSED, "the order was not renewed in time: the laptop does not answer any more")
            self._demand_guard()
            self._demand_led()
            if lead is not None:
                place_m = lead()
                self.drone.lead(self.fence.clamped(place_m) if self.fence else place_m, self.yaw_rad)
            self.beat()
            self.talk.turn(1 / RATE_HZ)
            yield

    def until(self, holds: Callable[[], bool], lead: Callable[[], Place] | None = None) -> None:
        """Take turns until something holds; errors as `turns`."""
        for _ in self.turns(lead):
            if holds():
                return

    def ask(
        self,
        ask: Callable[[], None],
        done: Callable[[], bool],
        what: str,
        lead: Callable[[], Place] | None = None,
    ) -> None:
        """Send a command again and again until it is done; send set-points meanwhile.

        Raises:
            FlightError: It was not done in time; has the last text of the autopilot.
        """
        began_s, asked_s = time.monotonic(), 0.0
        for _ in self.turns(lead):
            if done():
                return
            if time.monotonic() > began_s + ANSWERS_S:
                raise FlightError(REFUSED, f"the autopilot refuses {what} ({self.drone.said})")
            if time.monotonic() > asked_s:
                asked_s = time.monotonic() + AGAIN_S
                ask()

    def _demand_own_time(self) -> None:
        """Go on only if this program was not suspended or delayed for longer than `GAP_S`."""
        before_s, self._turned_s = self._turned_s, time.monotonic()
        if self.state == FLYING and before_s is not None and (gap_s := self._turned_s - before_s) > GAP_S:
            raise FlightError(LAPSED, f"the pilot did not run for {gap_s:.1f} s")

    def _demand_guard(self) -> None:
        """Go on only while the guard runs."""
        if self._liveness is not None and (why := self._liveness.look()):
            raise FlightError(GONE, f"the guard {why}")

    def _demand_led(self) -> None:
        """Go on only while the autopilot follows set-points, and is inside the fence."""
        drone = self.drone
        if self.state != FLYING:
            return
        if drone.silent_s > _SILENT_S:
            lost = ", its connection is closed" if self.talk.link.lost_since_s is not None else ""
            raise FlightError(REFUSED, f"no heartbeat of the autopilot for {_SILENT_S:g} s{lost}")
        if not drone.guided:
            if self._liveness is not None and self._liveness.other_state == LANDING:
                raise FlightError(GONE, "the guard brings it down")
            raise FlightError(TAKEN, f"another party flies it ({drone.said})")
        if not self.rose:
            return
        if not drone.armed:
            raise FlightError(TAKEN, f"its motors have stopped ({drone.said})")
        if drone.unplaced_s > _BLIND_S:
            raise FlightError(REFUSED, f"it has not reported its position for {_BLIND_S:g} s")
        if self.fence is not None and drone.place_m is not None and (breach := self.fence.breach(drone.place_m)):
            raise FlightError(FENCED, breach)
