"""Fly a drone for a trial, by set-points, and bring it down when nobody leads it any more.

The laptop gives orders in a file, each with a lease: for how many seconds it holds. An order that is not renewed in
time means that the laptop is gone, and a signal that the job is to end: both bring the drone down, as it was told to
be brought down. What an autopilot does that nobody leads any more is its own: PX4 has a fail-safe for it, so that the
drone does not depend on this program either (COM_OF_LOSS_T, COM_OBL_RC_ACT); ArduCopter stays where it is.
"""

from __future__ import annotations

import math
import threading
import time
from functools import partial
from typing import Callable, Iterator, Sequence

from fieldkit.agent.arming import ArmingCheck
from fieldkit.agent.autopilot import AutopilotState, AutopilotTalk
from fieldkit.agent.dialect import ARM, Command, FlightDialect
from fieldkit.agent.flight_log import FlightLog
from fieldkit.agent.flight_plan import CLIMB, GO, HOME, LEAVE, STAY, FlightPlan, Place, along
from fieldkit.agent.landing import (
    AGAIN_S,
    ANSWERS_S,
    CALLED_OFF,
    LAPSED,
    REFUSED,
    TAKEN,
    FlightError,
    bring_down,
    say,
    unhurried,
)
from fieldkit.agent.mavlink_frames import ACCEPTED, ATTITUDE, HEARTBEAT, LOCAL_POSITION_NED
from fieldkit.agent.mavlink_links import opened
from fieldkit.agent.orders import Orders

RATE_HZ = 10.0
"""How often it leads, looks for orders, and asks to be told where the drone is, and in which mode."""

_HEARD = (HEARTBEAT, LOCAL_POSITION_NED, ATTITUDE)
_NEAR_M = 0.3
_SLOW_M_S = 0.2
_RISEN = 0.9
"""Share of a take-off by command behind which set-points lead."""
_SETTLES_S = 1.0
"""So long set-points come before the mode that follows them (PX4 user guide, offboard mode)."""
_SILENT_S = 10.0
"""So long it leads one that it does not hear."""


class OffboardPilot:
    """Flies one drone.

    Args:
        plan: What it flies.
        over: Set when it is to end.
    """

    def __init__(self, plan: FlightPlan, over: threading.Event) -> None:
        self._plan = plan
        self._over = over
        self._log = FlightLog(plan.log)
        self._talk = AutopilotTalk(opened(plan.connection), self._note)
        self._drone = self._talk.drone
        self._orders = Orders(plan.orders, (STAY, CLIMB, GO, HOME, LEAVE), plan.lease_s)
        self._followed = self._rose = False

    def fly(self) -> None:
        """Fly, as the orders come.

        Raises:
            FlightError: It ended otherwise; the drone was brought down, where that was possible.
        """
        try:
            self._flown()
        except FlightError as error:
            # What it does not lead is somebody else's, unless it was to watch that.
            leads = self._followed and self._drone.armed
            if error.code != TAKEN and (leads or not self._plan.height_m):
                self._give_up(error)
            raise
        except Exception as error:
            if self._followed:
                self._give_up(error)  # whatever fails here, nobody else brings it down
            raise
        finally:
            for kind in _HEARD:
                self._drone.ask_for(kind, 0)

    def _give_up(self, error: Exception) -> None:
        """Bring it down where the flight does not go on; errors as `bring_down`."""
        say(f"{self._plan.abort}: {error}")
        self._log.phase = "coming down"
        with unhurried(self._plan.unhurried):
            bring_down(self._talk, self._plan.abort)
        say("landed")

    def _flown(self) -> None:
        plan, drone = self._plan, self._drone
        say(f"waiting for the heartbeat of an autopilot at {plan.connection}")
        self._until(lambda: drone.alive)
        say("ready")
        if not plan.height_m:
            self._until(lambda: self._orders.order == LEAVE)
            return
        dialect, begin_m, yaw_rad = self._stands()
        self._log.begin(begin_m, yaw_rad)
        self._enter("standing")
        self._until(lambda: self._orders.order in (CLIMB, HOME))
        corners_m = plan.corners_m(begin_m, yaw_rad)
        if self._orders.order == CLIMB:
            self._rise(dialect, begin_m, corners_m[0])
            self._go(corners_m)
            if plan.end == "return":
                self._back(begin_m)
        self._enter("coming down")
        bring_down(self._talk, "land")
        say("landed")

    def _stands(self) -> tuple[FlightDialect, Place, float]:
        """Return how it is flown, where it stands, once it says so, and where its nose points."""
        drone = self._drone
        if drone.dialect is None:
            raise FlightError(REFUSED, _sentences(ArmingCheck(drone, self._plan.needs)))
        asked_s = 0.0
        if drone.armed:
            say("waiting until its motors stand: somebody flies it, or it is coming down")
        for _ in self._turns():
            if time.monotonic() > asked_s:
                asked_s = time.monotonic() + 1.0
                for kind in _HEARD:
                    drone.ask_for(kind, RATE_HZ)
            if not drone.armed and drone.place_m is not None and drone.yaw_rad is not None:
                return drone.dialect, drone.place_m, drone.yaw_rad
        raise AssertionError("turns end by errors alone")

    def _rise(self, dialect: FlightDialect, begin_m: Place, top_m: Place) -> None:
        """Arm it, if nothing speaks against it, and rise straight to the first point of its way."""
        drone, began_s = self._drone, time.monotonic()
        commands = dialect.take_off(self._plan.height_m, self._plan.climb_m_s)
        waits = None if commands else lambda: begin_m
        if waits is not None:
            self._until(lambda: time.monotonic() - began_s > _SETTLES_S, lead=waits)
        self._ask(lambda: drone.command(*dialect.guide()), lambda: drone.guided, f"the mode {dialect.guided}", waits)
        self._followed = True
        self._may_rise(waits)
        self._ask(lambda: drone.command(ARM, 1), lambda: drone.armed, "to arm", waits)
        self._rose = True
        self._enter("climbing")
        if commands:
            self._lift(commands)
        way_m, began_s = [drone.place_m or begin_m, top_m], time.monotonic()
        self._until(
            lambda: _near(drone.place_m, top_m) or self._orders.order == HOME,
            lead=lambda: along(way_m, (time.monotonic() - began_s) * self._plan.climb_m_s),
        )
        self._enter("up")
        self._until(lambda: self._orders.order in (GO, HOME), lead=lambda: top_m)

    def _may_rise(self, waits: Callable[[], Place] | None) -> None:
        """Ask whether it may be armed.

        Raises:
            FlightError: It may not; says why, and what to do.
        """
        check = ArmingCheck(self._drone, self._plan.needs)
        for _ in self._turns(waits):
            check.ask()
            if check.done:
                break
        if why := _sentences(check):
            raise FlightError(REFUSED, why)

    def _lift(self, commands: Sequence[Command]) -> None:
        """Let it rise by commands, of which it must do the last, nearly to where that says."""
        drone, ground_m = self._drone, self._drone.place_m
        *before, last = commands
        for command in commands:
            drone.answers.pop(int(command[0]), None)
        for command in before:
            self._ask(partial(drone.command, *command), partial(self._answered, command[0]), "to be told how fast")
        self._ask(partial(drone.command, *last), lambda: drone.answers.get(int(last[0])) == ACCEPTED, "to take off")
        height_m = self._plan.height_m

        def lifted() -> bool:
            risen_m = ground_m[2] - drone.place_m[2] if ground_m and drone.place_m else 0.0
            return risen_m > _RISEN * height_m or (risen_m > height_m / 2 and drone.speed_m_s < _SLOW_M_S)

        self._until(lambda: lifted() or self._orders.order == HOME)

    def _answered(self, command: float) -> bool:
        return int(command) in self._drone.answers

    def _go(self, corners_m: Sequence[Place]) -> None:
        """Fly the way, and wait at its end."""
        began_s, said = time.monotonic(), False
        if self._orders.order == GO:
            self._enter("flying")
        for _ in self._turns(lambda: along(corners_m, (time.monotonic() - began_s) * self._plan.speed_m_s)):
            if self._orders.order == HOME:
                return
            if not said and _near(self._drone.place_m, corners_m[-1]):
                said = True
                self._enter("there")

    def _back(self, begin_m: Place) -> None:
        """Fly to above where it rose."""
        here_m = self._drone.place_m
        if here_m is None:
            raise FlightError(REFUSED, "the autopilot does not say any more where it is")
        above_m, began_s = (begin_m[0], begin_m[1], here_m[2]), time.monotonic()
        way_m = [here_m, above_m]
        self._enter("coming back")
        self._until(
            lambda: _near(self._drone.place_m, above_m) and self._drone.speed_m_s < _SLOW_M_S,
            lead=lambda: along(way_m, (time.monotonic() - began_s) * self._plan.speed_m_s),
        )

    def _ask(
        self,
        ask: Callable[[], None],
        done: Callable[[], bool],
        what: str,
        waits: Callable[[], Place] | None = None,
    ) -> None:
        """Ask for something until it is so; lead it meanwhile to where it waits.

        Raises:
            FlightError: It did not become so; says what the autopilot said.
        """
        began_s, asked_s = time.monotonic(), 0.0
        for _ in self._turns(waits):
            if done():
                return
            if time.monotonic() > began_s + ANSWERS_S:
                why = self._drone.said or "it does not say why"
                raise FlightError(REFUSED, f"the autopilot refuses {what}: {why}")
            if time.monotonic() > asked_s:
                asked_s = time.monotonic() + AGAIN_S
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
            self._demand_led()
            if lead is not None:
                self._drone.lead(lead())
            self._talk.turn(1 / RATE_HZ)
            yield

    def _demand_led(self) -> None:
        """Go on only while the autopilot is there, and goes where this program leads it.

        Raises:
            FlightError: It does not.
        """
        drone = self._drone
        if not self._followed:
            return
        if drone.silent_s > _SILENT_S:
            raise FlightError(REFUSED, f"the autopilot has been silent for {_SILENT_S:g} s")
        if not drone.guided:
            raise FlightError(TAKEN, f"somebody else flies it: {drone.said or 'it is in another mode'}")
        if self._rose and not drone.armed:
            raise FlightError(TAKEN, f"its motors stand: {drone.said or 'it does not say why'}")

    def _note(self, drone: AutopilotState) -> None:
        self._log.note(drone.place_m, drone.speed_m_s)

    def _enter(self, phase: str) -> None:
        """Say what the flight is about from now on."""
        self._log.phase = phase
        say(phase)


def fly(plan: FlightPlan, over: threading.Event) -> int:
    """Fly a drone until the orders end, or `over` is set; return the exit code.

    Raises:
        OSError: The connection cannot be opened, or has ended.
    """
    try:
        OffboardPilot(plan, over).fly()
    except FlightError as error:
        say(f"error: {error}")
        return error.code
    return 0


def _sentences(check: ArmingCheck) -> str:
    """Return what speaks against a flight, and what to do about it; empty where nothing does."""
    return "; ".join(f"{fault.what} ({fault.remedy})" for fault in check.faults() if fault.grave)


def _near(place_m: Place | None, goal_m: Place) -> bool:
    return place_m is not None and math.dist(place_m, goal_m) < _NEAR_M
