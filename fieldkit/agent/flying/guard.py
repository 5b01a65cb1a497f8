"""The guard of a drone: a program that lands the drone if the program that flies it has stopped.

The guard of a step `fly` acts only during a flight of its pilot, and only in the mode that the pilot has set. The
guard of a drone that other programs fly acts in all modes in which programs control a drone. If the drone is already
armed when the guard starts, the guard also acts in the current mode, until the mode changes for the first time. In
all other modes a person or a failsafe of the autopilot controls the drone, and the guard sends nothing.
"""

from __future__ import annotations

import threading
import time

from fieldkit.agent.autopilots.autopilot import GUARD
from fieldkit.agent.autopilots.mavlink_frames import HEARTBEAT, LOCAL_POSITION_NED
from fieldkit.agent.flying import liveness
from fieldkit.agent.flying.flight_plan import LEAVE, STAY, FlightPlan
from fieldkit.agent.flying.landing import (
    LEASE_EXPIRED,
    PEER_STOPPED,
    FlightError,
    alarm,
    bring_down,
    landing_marker,
    log_line,
)
from fieldkit.agent.flying.liveness import ENDED, FLYING, LANDING, LivenessFile
from fieldkit.agent.flying.loop import GAP_S, RATE_HZ, wait_for_heartbeat
from fieldkit.agent.flying.session import AutopilotSession
from fieldkit.agent.orders import CANCELLED, Orders


class FlightGuard:
    """Guards one drone.

    Args:
        plan: A plan with `guards`, and with `liveness` if fieldkit's pilot flies the drone.
        stop_event: Set when the job must stop.

    Raises:
        OSError: The connection or the liveness file cannot be opened.
    """

    def __init__(self, plan: FlightPlan, stop_event: threading.Event) -> None:
        self._plan = plan
        self._stop_event = stop_event
        self._liveness = LivenessFile(plan.liveness, liveness.GUARD) if plan.liveness else None
        self._state = liveness.IDLE
        self._session = AutopilotSession(plan.connection, component=GUARD)
        self._drone = self._session.drone
        self._orders = Orders(plan.orders, (STAY, LEAVE), plan.lease_s)
        self._iteration_s: float | None = None
        # The mode of a drone that was already armed at the start of the guard; None after the first change of mode.
        self._first_mode: int | None = None
        self._mode_name = ""

    def run(self) -> None:
        """Guard the drone until the order `leave`.

        Raises:
            FlightError: The flight was aborted. If the guard may control the drone, it has landed, or an alarm is in
                the log.
        """
        try:
            log_line(f"waiting for the heartbeat of an autopilot at {self._plan.connection}")
            self._wait_for_autopilot()
            log_line("ready")
            self._supervise()
        except FlightError as error:
            self._abort_flight(error)
            raise
        finally:
            self._state = ENDED
            self._update()
            self._session.close()

    def _wait_for_autopilot(self) -> None:
        wait_for_heartbeat(self._session, self._plan.connection, self._stop_event, self._update)
        self._first_mode = self._drone.mode if self._drone.armed else None
        for kind in (HEARTBEAT, LOCAL_POSITION_NED):
            self._drone.commands.request_stream(kind, RATE_HZ)
        # The lease of the orders begins now.
        self._orders = Orders(self._plan.orders, (STAY, LEAVE), self._plan.lease_s)
        self._iteration_s = None

    def _supervise(self) -> None:
        """Return after the order `leave`; raise `FlightError` if the drone must land."""
        while self._orders.order != LEAVE:
            previous_s, self._iteration_s = self._iteration_s, time.monotonic()
            if previous_s is not None and (gap_s := self._iteration_s - previous_s) > GAP_S:
                raise FlightError(LEASE_EXPIRED, f"the guard did not run for {gap_s:.1f} s")
            if self._stop_event.is_set():
                raise FlightError(CANCELLED, "the job was cancelled")
            self._orders.poll()
            if self._orders.expired:
                raise FlightError(LEASE_EXPIRED, "the order was not renewed in time: the laptop no longer answers")
            self._require_pilot()
            if self._first_mode != self._drone.mode:
                self._first_mode = None
            self._exchange()

    def _require_pilot(self) -> None:
        """If the pilot has stopped during its flight, kill it, so that it stays stopped, and raise `FlightError`."""
        if self._liveness is None:
            return
        problem = self._liveness.poll()
        if problem and self._pilot_flies:
            self._liveness.kill_other()
            raise FlightError(PEER_STOPPED, f"the pilot {problem}")

    @property
    def _pilot_flies(self) -> bool:
        """Whether fieldkit's pilot has started a flight and has not finished it."""
        return self._liveness is not None and self._liveness.other_state in (FLYING, LANDING)

    def _may_command(self) -> bool:
        """Return True if the drone is in a mode in which the guard may control it."""
        drone = self._drone
        if self._liveness is not None:
            return drone.guided
        is_program = drone.dialect is not None and drone.dialect.is_program_controlled(drone.mode)
        return is_program or drone.mode == self._first_mode

    def _abort_flight(self, error: FlightError) -> None:
        """Land the drone if the guard may control it; if it cannot be landed, log an alarm and raise the error."""
        drone = self._drone
        if not drone.armed or not (self._pilot_flies if self._liveness is not None else self._may_command()):
            return
        log_line(f"{self._plan.abort}: {error}")
        self._state = LANDING
        try:
            with landing_marker(self._plan.landing_marker):
                bring_down(self._session, self._plan.abort, self._may_command, self._update)
        except FlightError:
            log_line(alarm(drone))
            raise
        log_line("landed")

    def _exchange(self) -> None:
        self._update()
        self._session.exchange(1 / RATE_HZ)

    def _update(self) -> None:
        """Update the liveness entry of this program, and log a changed mode of the autopilot."""
        if self._liveness is not None:
            self._liveness.update(self._state)
        if self._drone.dialect is not None and self._drone.mode_name != self._mode_name:
            self._mode_name = self._drone.mode_name
            log_line(f"mode {self._mode_name}")
