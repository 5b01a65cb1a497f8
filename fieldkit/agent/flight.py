"""Fly a drone for a trial, by set-points, and bring it down where the flight is cut short.

The laptop gives orders in a file, each with a lease: for how many seconds it holds. An order that is not renewed in
time means that the laptop is gone, and a signal that the job is to end: both bring the drone down, as its plan says.
A second program on the drone, its guard (`flying.guard`), does so where this one does not run any more, and this one
where the guard does not. The autopilot's own failsafe is beside both: PX4 has one for missing set-points
(COM_OF_LOSS_T, COM_OBL_RC_ACT); ArduCopter stays where it is.
"""

from __future__ import annotations

import json
import math
import threading
import time
from dataclasses import asdict
from functools import partial
from typing import Callable, Sequence

from fieldkit.agent.arming import ArmingCheck
from fieldkit.agent.dialect import ARM, Command, FlightDialect
from fieldkit.agent.flight_log import FlightLog
from fieldkit.agent.flight_plan import CLIMB, GO, HOME, MISPLACED, FlightPlan, along
from fieldkit.agent.flying import guard, rescue
from fieldkit.agent.flying.liveness import ENDED, FLYING, LANDING
from fieldkit.agent.flying.loop import FlightLoop
from fieldkit.agent.flying.origin import FRAME, FlightOrigin, OriginError, Place, frame_id, settled
from fieldkit.agent.landing import REFUSED, TAKEN, FlightError, alarm, bring_down, say, unhurried
from fieldkit.agent.mavlink_frames import ACCEPTED

_NEAR_M = 0.3
_SLOW_M_S = 0.2
_LIFTED_M = 0.3
"""A drone that is higher than this over the ground has taken off."""
_RISEN = 0.9
"""Share of a take-off by command after which set-points lead."""
_SETTLES_S = 1.0
"""Set-points are sent for this time before the mode that follows them (PX4 user guide, offboard mode)."""
_ORIGIN_S = 3.0
"""Latitude and longitude have this time to arrive; some drones do not know them."""
_BOOT_ID = "/proc/sys/kernel/random/boot_id"


class OffboardPilot:
    """Flies one drone.

    Args:
        plan: The flight.
        over: Set when the job is to end.

    Raises:
        OSError: The connection or the file of liveness cannot be opened.
    """

    def __init__(self, plan: FlightPlan, over: threading.Event) -> None:
        self._plan = plan
        self._log = FlightLog(plan.log)
        self._loop = FlightLoop(plan, over, self._log.note)
        self._drone = self._loop.drone

    def fly(self) -> None:
        """Fly, as the orders come.

        Raises:
            FlightError: The flight was cut short; the drone was brought down, where that is ours to do.
        """
        try:
            self._fly()
        except Exception as error:
            if self._loop.state == FLYING:
                self._give_up(error)
            elif self._loop.state == LANDING:
                say(alarm(self._drone))
            raise
        finally:
            self._loop.state = ENDED
            self._loop.beat()
            self._loop.talk.close()

    def _give_up(self, error: Exception) -> None:
        """Bring the drone down where the flight does not go on; errors as `bring_down`, with an alarm in the log."""
        drone = self._drone
        if isinstance(error, FlightError) and error.code == TAKEN:
            if drone.armed or not drone.alive:
                say(alarm(drone))
            return
        say(f"{self._plan.abort}: {error}")
        self._loop.state = LANDING
        self._log.phase = "coming down"
        try:
            with unhurried(self._plan.unhurried):
                bring_down(self._loop.talk, self._plan.abort, lambda: drone.guided, self._loop.beat)
        except Exception:
            say(alarm(drone))
            raise
        say("landed")

    def _fly(self) -> None:
        plan, loop = self._plan, self._loop
        say(f"waiting for the heartbeat of an autopilot at {plan.connection}")
        loop.wait_for_autopilot()
        say("ready")
        dialect, start_m = self._stand()
        origin = self._origin(start_m)
        loop.begin(origin, start_m[2])
        self._log.begin(origin, start_m[2])
        say(f"origin {json.dumps(asdict(origin))}")
        self._enter("standing")
        loop.until(lambda: loop.orders.order in (CLIMB, HOME))
        if loop.orders.order == CLIMB:
            corners_m = plan.corners_m(origin, start_m[2])
            self._rise(dialect, start_m, corners_m[0])
            self._go(corners_m)
            if plan.end == "return":
                self._return(origin)
        self._enter("coming down")
        loop.state = LANDING if loop.rose else loop.state
        with unhurried(plan.unhurried):
            bring_down(loop.talk, "land", lambda: self._drone.guided, loop.beat)
        self._log.end("landed")
        say("landed")

    def _stand(self) -> tuple[FlightDialect, Place]:
        """Return how the drone is flown, and where it is once its motors have stopped and it reports its position."""
        drone = self._drone
        if drone.dialect is None:
            raise FlightError(REFUSED, _sentences(ArmingCheck(drone, self._plan.needs)))
        if drone.armed:
            say("waiting until its motors have stopped: another party flies it, or it is coming down")
        self._loop.until(lambda: not drone.armed and drone.place_m is not None and drone.yaw_rad is not None)
        assert drone.place_m is not None
        return drone.dialect, drone.place_m

    def _origin(self, start_m: Place) -> FlightOrigin:
        """Return the origin in the frame of this start.

        Raises:
            FlightError: The drone is not at the origin of its trial, or it is not known whether it is.
        """
        drone, began_s = self._drone, time.monotonic()
        self._loop.until(lambda: drone.degrees is not None or time.monotonic() > began_s + _ORIGIN_S)
        latitude, longitude = drone.degrees or (None, None)
        if drone.yaw_rad is None:
            raise FlightError(REFUSED, "it does not report its heading (ATTITUDE)")
        frame = frame_id(_boot_id(), drone.booted_s)
        start = FlightOrigin(FRAME, frame, start_m[0], start_m[1], drone.yaw_rad, latitude, longitude)
        try:
            return settled(FlightOrigin.of(self._plan.origin) if self._plan.origin else None, start)
        except OriginError as error:
            say(MISPLACED)
            raise FlightError(REFUSED, str(error)) from error

    def _rise(self, dialect: FlightDialect, start_m: Place, top_m: Place) -> None:
        """Arm the drone, if nothing is against it, and rise straight up, then to the first point of its way."""
        loop, drone, began_s = self._loop, self._drone, time.monotonic()
        commands = dialect.take_off(self._plan.height_m, self._plan.climb_m_s)
        waits = None if commands else lambda: start_m
        if waits is not None:
            loop.until(lambda: time.monotonic() - began_s > _SETTLES_S, lead=waits)
        loop.ask(lambda: drone.command(*dialect.guide()), lambda: drone.guided, f"the mode {dialect.guided}", waits)
        loop.state = FLYING
        self._demand_armable(waits)
        loop.ask(lambda: drone.command(ARM, 1), lambda: drone.armed, "to arm", waits)
        loop.rose = True
        self._enter("climbing")
        if commands:
            self._lift(commands, start_m)
        way_m, began_s = [drone.place_m or start_m, (*start_m[:2], top_m[2]), top_m], time.monotonic()
        loop.until(
            lambda: _near(drone.place_m, top_m) or loop.orders.order == HOME,
            lead=lambda: along(way_m, (time.monotonic() - began_s) * self._plan.climb_m_s),
        )
        self._enter("up")
        loop.until(lambda: loop.orders.order in (GO, HOME), lead=lambda: top_m)

    def _demand_armable(self, waits: Callable[[], Place] | None) -> None:
        """Request the arming checks.

        Raises:
            FlightError: It may not be armed; says why, and what to do.
        """
        check = ArmingCheck(self._drone, self._plan.needs)
        for _ in self._loop.turns(waits):
            check.ask()
            if check.done:
                break
        if why := _sentences(check):
            raise FlightError(REFUSED, why)

    def _lift(self, commands: Sequence[Command], start_m: Place) -> None:
        """Let the drone rise by commands, of which it must do the last, nearly to the height in that one."""
        drone, height_m = self._drone, self._plan.height_m

        def risen_m() -> float:
            return start_m[2] - drone.place_m[2] if drone.place_m else 0.0

        def risen() -> bool:
            slow_m = height_m / 2 if drone.speed_m_s < _SLOW_M_S else math.inf
            return risen_m() > min(_RISEN * height_m, slow_m)

        *before, last = commands
        for command in commands:
            drone.answers.pop(int(command[0]), None)
        for command in before:
            self._loop.ask(partial(drone.command, *command), partial(self._answered, command[0]), "a speed to climb")
        # An answer may be lost, and a second command to take off is refused in the air.
        accepted = lambda: drone.answers.get(int(last[0])) == ACCEPTED or risen_m() > _LIFTED_M  # noqa: E731
        self._loop.ask(partial(drone.command, *last), accepted, "to take off")
        self._loop.until(lambda: risen() or self._loop.orders.order == HOME)

    def _answered(self, command: float) -> bool:
        return int(command) in self._drone.answers

    def _go(self, corners_m: Sequence[Place]) -> None:
        """Fly the way, and wait at its end."""
        loop, began_s, is_there = self._loop, time.monotonic(), False
        if loop.orders.order == GO:
            self._enter("flying")
        for _ in loop.turns(lambda: along(corners_m, (time.monotonic() - began_s) * self._plan.speed_m_s)):
            if loop.orders.order == HOME:
                return
            if not is_there and _near(self._drone.place_m, corners_m[-1]):
                is_there = True
                self._enter("there")

    def _return(self, origin: FlightOrigin) -> None:
        """Fly to above the origin."""
        drone = self._drone
        assert drone.last_place_m is not None, "it has risen"
        here_m = drone.last_place_m
        above_m, began_s = origin.at(0.0, 0.0, here_m[2]), time.monotonic()
        way_m = [here_m, above_m]
        self._enter("coming back")
        self._loop.until(
            lambda: _near(drone.place_m, above_m) and drone.speed_m_s < _SLOW_M_S,
            lead=lambda: along(way_m, (time.monotonic() - began_s) * self._plan.speed_m_s),
        )

    def _enter(self, phase: str) -> None:
        """Report what the flight is about from now on."""
        self._log.phase = phase
        say(phase)


def fly(plan: FlightPlan, over: threading.Event) -> int:
    """Fly a drone, or guard it, until the orders end or `over` is set, or rescue it; return the exit code.

    Raises:
        OSError: The connection cannot be opened.
    """
    try:
        if plan.rescues:
            rescue.rescue(plan)
        elif plan.guards:
            guard.FlightGuard(plan, over).run()
        else:
            OffboardPilot(plan, over).fly()
    except FlightError as error:
        say(f"error: {error}")
        return error.code
    return 0


def _boot_id() -> str:
    """Return the identity of the boot of this computer (random(4)); empty where there is none."""
    try:
        with open(_BOOT_ID, encoding="ascii") as file:  # noqa: PTH123 (Python 3.8)
            return file.read(100).strip()
    except OSError:
        return ""


def _sentences(check: ArmingCheck) -> str:
    """Return what is against a flight, and what to do about it; empty where nothing is."""
    return "; ".join(f"{fault.what} ({fault.remedy})" for fault in check.faults() if fault.grave)


def _near(place_m: Place | None, goal_m: Place) -> bool:
    return place_m is not None and math.dist(place_m, goal_m) < _NEAR_M
