"""The guard of a drone: a program that brings the drone down where the program that leads it does not run any more.

The guard of a step `fly` acts only during a flight of its pilot, and only in the mode that the pilot has set. A guard
of a drone that is flown by other programs acts in modes in which programs lead a drone, and in the mode that a flying
drone had when the guard began, until that is changed for the first time. In all other modes a person or a failsafe of
the autopilot has the drone, and the guard sends nothing.
"""

from __future__ import annotations

import threading
import time

from fieldkit.agent.autopilot import GUARD
from fieldkit.agent.flight_plan import LEAVE, STAY, FlightPlan
from fieldkit.agent.flying import liveness
from fieldkit.agent.flying.liveness import ENDED, FLYING, LANDING, LivenessFile
from fieldkit.agent.flying.loop import GAP_S, HEARTBEAT_S, RATE_HZ
from fieldkit.agent.flying.talk import AutopilotTalk
from fieldkit.agent.landing import CALLED_OFF, GONE, LAPSED, REFUSED, FlightError, alarm, bring_down, say, unhurried
from fieldkit.agent.mavlink_frames import HEARTBEAT, LOCAL_POSITION_NED
from fieldkit.agent.orders import Orders


class FlightGuard:
    """Guards one drone.

    Args:
        plan: With `guards`; with `liveness` where a pilot of ours flies the drone.
        over: Set when the job is to end.

    Raises:
        OSError: The connection or the file of liveness cannot be opened.
    """

    def __init__(self, plan: FlightPlan, over: threading.Event) -> None:
        self._plan = plan
        self._over = over
        self._liveness = LivenessFile(plan.liveness, liveness.GUARD) if plan.liveness else None
        self._state = liveness.IDLE
        self._talk = AutopilotTalk(plan.connection, component=GUARD)
        self._drone = self._talk.drone
        self._orders = Orders(plan.orders, (STAY, LEAVE), plan.lease_s)
        self._turned_s: float | None = None
        self._first_mode: int | None = None
        self._mode_name = ""

    def run(self) -> None:
        """Guard the drone until the order to leave it.

        Raises:
            FlightError: The flight was cut short; the drone was brought down, where that is ours to do.
        """
        try:
            say(f"waiting for the heartbeat of an autopilot at {self._plan.connection}")
            self._wait_for_autopilot()
            say("ready")
            self._watch()
        except FlightError as error:
            self._give_up(error)
            raise
        finally:
            self._state = ENDED
            self._beat()
            self._talk.close()

    def _wait_for_autopilot(self) -> None:
        began_s = time.monotonic()
        while not self._drone.alive:
            if self._over.is_set():
                raise FlightError(CALLED_OFF, "the job was ended")
            if time.monotonic() > began_s + HEARTBEAT_S:
                where = self._plan.connection
                raise FlightError(REFUSED, f"no heartbeat of an autopilot at {where} in {HEARTBEAT_S:g} s")
            self._turn()
        self._first_mode = self._drone.mode if self._drone.armed else None
        for kind in (HEARTBEAT, LOCAL_POSITION_NED):
            self._drone.request_stream(kind, RATE_HZ)
        self._orders = Orders(self._plan.orders, (STAY, LEAVE), self._plan.lease_s)
        self._turned_s = None

    def _watch(self) -> None:
        """Return with the order to leave; raise `FlightError` where the drone is to come down."""
        while self._orders.order != LEAVE:
            before_s, self._turned_s = self._turned_s, time.monotonic()
            if before_s is not None and (gap_s := self._turned_s - before_s) > GAP_S:
                raise FlightError(LAPSED, f"the guard did not run for {gap_s:.1f} s")
            if self._over.is_set():
                raise FlightError(CALLED_OFF, "the job was ended")
            self._orders.look()
            if self._orders.lapsed:
                raise FlightError(LAPSED, "the order was not renewed in time: the laptop does not answer any more")
            self._demand_pilot()
            if self._first_mode != self._drone.mode:
                self._first_mode = None
            self._turn()

    def _demand_pilot(self) -> None:
        """Go on only while the pilot runs, if it flies."""
        if self._liveness is None:
            return
        why = self._liveness.look()
        if why and self._flies:
            self._liveness.end_other()
            raise FlightError(GONE, f"the pilot {why}")

    @property
    def _flies(self) -> bool:
        """Whether a pilot of ours has begun a flight and has not ended it."""
        return self._liveness is not None and self._liveness.other_state in (FLYING, LANDING)

    def _led(self) -> bool:
        """Return whether the drone is in a mode in which it is ours to bring down."""
        drone = self._drone
        if self._liveness is not None:
            return drone.guided
        program = drone.dialect is not None and drone.dialect.is_led(drone.mode)
        return program or drone.mode == self._first_mode

    def _give_up(self, error: FlightError) -> None:
        """Bring the drone down where that is ours to do; errors as `bring_down`, with an alarm in the log."""
        drone = self._drone
        if not drone.armed or not (self._flies if self._liveness is not None else self._led()):
            return
        say(f"{self._plan.abort}: {error}")
        self._state = LANDING
        try:
            with unhurried(self._plan.unhurried):
                bring_down(self._talk, self._plan.abort, self._led, self._beat)
        except FlightError:
            say(alarm(drone))
            raise
        say("landed")

    def _turn(self) -> None:
        self._beat()
        self._talk.turn(1 / RATE_HZ)

    def _beat(self) -> None:
        """Show the pilot that this program runs, and report modes of the autopilot that are new."""
        if self._liveness is not None:
            self._liveness.beat(self._state)
        if self._drone.dialect is not None and self._drone.mode_name != self._mode_name:
            self._mode_name = self._drone.mode_name
            say(f"mode {self._mode_name}")
