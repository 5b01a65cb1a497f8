"""Fly a drone for a trial by set-points (target positions), and land it if the flight is aborted.

The laptop writes orders to a file. Each order has a lease, the number of seconds for which it is valid. This program
is the pilot. A second program on the drone, the guard (`flying.guard`), lands the drone if the pilot stops.

The pilot lands the drone, or lets it return and land as its plan requires, if the flight cannot continue. Examples:
an order is not renewed in time because the laptop or its link is lost, a signal cancels the job, the guard stops, or
the drone is outside its fence. It does not control a drone that a person or another program flies. If set-points are
missing, the autopilot reacts: PX4 has a failsafe (COM_OF_LOSS_T, COM_OBL_RC_ACT); ArduCopter holds its position.
"""

from __future__ import annotations

import json
import math
import threading
import time
from dataclasses import asdict
from functools import partial
from typing import Callable, Sequence

from fieldkit.agent.autopilots.dialect import ARM, Command, FlightDialect
from fieldkit.agent.autopilots.mavlink_frames import ACCEPTED
from fieldkit.agent.boot_clock import boot_id
from fieldkit.agent.flying import guard, rescue
from fieldkit.agent.flying.arming import ArmingCheck
from fieldkit.agent.flying.flight_log import FlightLog
from fieldkit.agent.flying.flight_plan import (
    AT_PATH_END,
    AT_PATH_START,
    CLIMB,
    CLIMBING,
    DESCENDING,
    GO,
    HOME,
    MISPLACED,
    ON_GROUND,
    ON_PATH,
    RETURNING,
    FlightPlan,
    point_on_path,
)
from fieldkit.agent.flying.landing import (
    REFUSED,
    TAKEN_OVER,
    FlightError,
    alarm,
    bring_down,
    landing_marker,
    log_line,
)
from fieldkit.agent.flying.liveness import ENDED, FLYING, LANDING
from fieldkit.agent.flying.loop import FlightLoop
from fieldkit.agent.flying.origin import FRAME, FlightOrigin, OriginError, Position, frame_id, resolve_origin

_NEAR_M = 0.3
"""A drone within this distance of a point has reached the point."""
_SLOW_M_S = 0.2
"""A slower drone is considered to hover."""
_LIFTED_M = 0.3
"""A drone that is higher than this above the ground has taken off."""
_RISEN_FRACTION = 0.9
"""After a take-off by command, set-points are sent from this fraction of the target height."""
_SET_POINTS_S = 1.0
"""Set-points are sent for this time before the mode is selected in which the autopilot follows set-points (PX4 user
guide, offboard mode)."""
_COORDINATES_S = 3.0
"""Timeout for latitude and longitude, which some drones do not report."""


class OffboardPilot:
    """Flies one drone.

    Args:
        plan: The flight.
        stop_event: Set when the job must stop.

    Raises:
        OSError: The connection or the liveness file cannot be opened.
    """

    def __init__(self, plan: FlightPlan, stop_event: threading.Event) -> None:
        self._plan = plan
        self._log = FlightLog(plan.log)
        self._loop = FlightLoop(plan, stop_event, self._log.note)
        self._drone = self._loop.drone

    def fly(self) -> None:
        """Fly according to the orders.

        Raises:
            FlightError: The flight was aborted. If the drone was flying, it has landed, or an alarm is in the log.
        """
        try:
            self._fly()
        except Exception as error:
            if self._loop.state == FLYING:
                self._abort_flight(error)
            elif self._loop.state == LANDING:
                log_line(alarm(self._drone))
            raise
        finally:
            self._loop.state = ENDED
            self._loop.update()
            self._loop.session.close()

    def _abort_flight(self, error: Exception) -> None:
        """Land the drone, or let it return and land, after an error, unless a person or another program flies it.

        An alarm is logged if the drone does not land, or if a person or another program flies it.

        Raises the same errors as `bring_down`.
        """
        drone = self._drone
        if isinstance(error, FlightError) and error.code == TAKEN_OVER:
            if drone.armed or not drone.alive:
                log_line(alarm(drone))
            return
        log_line(f"{self._plan.abort}: {error}")
        self._loop.state = LANDING
        self._log.phase = DESCENDING
        try:
            with landing_marker(self._plan.landing_marker):
                bring_down(self._loop.session, self._plan.abort, lambda: drone.guided, self._loop.update)
        except Exception:
            log_line(alarm(drone))
            raise
        log_line("landed")

    def _fly(self) -> None:
        plan, loop = self._plan, self._loop
        log_line(f"waiting for the heartbeat of an autopilot at {plan.connection}")
        loop.wait_for_autopilot()
        log_line("ready")
        dialect, start_m = self._wait_until_ready()
        origin = self._origin(start_m)
        loop.set_origin(origin, start_m[2])
        self._log.begin(origin, start_m[2])
        log_line(f"origin {json.dumps(asdict(origin))}")
        self._start_phase(ON_GROUND)
        loop.run_until(lambda: loop.orders.order in (CLIMB, HOME))
        if loop.orders.order == CLIMB:
            corners_m = plan.corners_m(origin, start_m[2])
            self._take_off(dialect, start_m, corners_m[0])
            self._fly_path(corners_m)
            if plan.end == "return":
                self._fly_to_origin(origin)
        self._start_phase(DESCENDING)
        loop.state = LANDING if loop.has_armed else loop.state
        with landing_marker(plan.landing_marker):
            bring_down(loop.session, "land", lambda: self._drone.guided, loop.update)
        self._log.end("landed")
        log_line("landed")

    def _wait_until_ready(self) -> tuple[FlightDialect, Position]:
        """Wait until the motors have stopped, and position and heading are reported.

        Returns:
            The dialect and the position.

        Raises:
            FlightError: The family of the autopilot is unknown, or for the same reasons as in `FlightLoop.iterate`.
        """
        drone = self._drone
        if drone.dialect is None:
            raise FlightError(REFUSED, _fault_text(ArmingCheck(drone, self._plan.needs)))
        if drone.armed:
            log_line("waiting until its motors have stopped: a person or another program flies it, or it is landing")
        self._loop.run_until(lambda: not drone.armed and drone.position_m is not None and drone.yaw_rad is not None)
        assert drone.position_m is not None
        return drone.dialect, drone.position_m

    def _origin(self, start_m: Position) -> FlightOrigin:
        """Return the origin in the current local frame of the autopilot, which is valid until it reboots.

        Raises:
            FlightError: The drone is not at the origin of its trial, it cannot be determined whether it is there, or
                its heading is unknown.
        """
        drone, start_s = self._drone, time.monotonic()
        self._loop.run_until(
            lambda: drone.latitude_longitude is not None or time.monotonic() > start_s + _COORDINATES_S
        )
        latitude, longitude = drone.latitude_longitude or (None, None)
        if drone.yaw_rad is None:
            raise FlightError(REFUSED, "it does not report its heading (ATTITUDE)")
        frame = frame_id(boot_id(), drone.boot_time_s)
        start = FlightOrigin(FRAME, frame, start_m[0], start_m[1], drone.yaw_rad, latitude, longitude)
        try:
            return resolve_origin(FlightOrigin.from_values(self._plan.origin) if self._plan.origin else None, start)
        except OriginError as error:
            log_line(MISPLACED)
            raise FlightError(REFUSED, str(error)) from error

    def _take_off(self, dialect: FlightDialect, start_m: Position, top_m: Position) -> None:
        """Arm the drone if its checks pass, rise vertically, fly to the first point of the path, and wait there.

        Return after the order `go`, or early after the order `home`.
        """
        loop, drone, start_s = self._loop, self._drone, time.monotonic()
        commands = dialect.take_off_commands(self._plan.height_m, self._plan.climb_m_s)
        start_set_point = None if commands else lambda: start_m
        if start_set_point is not None:
            loop.run_until(lambda: time.monotonic() - start_s > _SET_POINTS_S, set_point=start_set_point)
        loop.command_until(
            lambda: drone.commands.send(*dialect.guided_command()),
            lambda: drone.guided,
            f"the mode {dialect.guided_mode}",
            start_set_point,
        )
        loop.state = FLYING
        self._require_armable(start_set_point)
        loop.command_until(lambda: drone.commands.send(ARM, 1), lambda: drone.armed, "arming", start_set_point)
        loop.has_armed = True
        self._start_phase(CLIMBING)
        if commands:
            self._climb_by_commands(commands, start_m)
        path_m, start_s = [drone.position_m or start_m, (*start_m[:2], top_m[2]), top_m], time.monotonic()
        loop.run_until(
            lambda: _is_near(drone.position_m, top_m) or loop.orders.order == HOME,
            set_point=lambda: point_on_path(path_m, (time.monotonic() - start_s) * self._plan.climb_m_s),
        )
        self._start_phase(AT_PATH_START)
        loop.run_until(lambda: loop.orders.order in (GO, HOME), set_point=lambda: top_m)

    def _require_armable(self, start_set_point: Callable[[], Position] | None) -> None:
        """Run the arming checks.

        Raises:
            FlightError: The drone cannot be armed; the message contains reasons and remedies.
        """
        check = ArmingCheck(self._drone, self._plan.needs)
        for _ in self._loop.iterate(start_set_point):
            check.request_missing()
            if check.is_complete:
                break
        if reasons := _fault_text(check):
            raise FlightError(REFUSED, reasons)

    def _climb_by_commands(self, commands: Sequence[Command], start_m: Position) -> None:
        """Command the take-off, and wait until the drone is near the target height or the order `home` arrives.

        Only the last command must be accepted.
        """
        drone, height_m = self._drone, self._plan.height_m

        def risen_m() -> float:
            return start_m[2] - drone.position_m[2] if drone.position_m else 0.0

        def has_risen() -> bool:
            # A drone that hovers above half of the target height has also finished its take-off.
            hover_threshold_m = height_m / 2 if drone.speed_m_s < _SLOW_M_S else math.inf
            return risen_m() > min(_RISEN_FRACTION * height_m, hover_threshold_m)

        *preceding_commands, last_command = commands  # the last one is the take-off
        for command in commands:
            drone.command_results.pop(int(command[0]), None)
        for command in preceding_commands:
            self._loop.command_until(
                partial(drone.commands.send, *command), partial(self._has_result, command[0]), "the climb speed"
            )
        # The acknowledgement may be lost, and a second command to take off is refused in the air.
        is_accepted = lambda: drone.command_results.get(int(last_command[0])) == ACCEPTED or risen_m() > _LIFTED_M  # noqa: E731
        self._loop.command_until(partial(drone.commands.send, *last_command), is_accepted, "the take-off")
        self._loop.run_until(lambda: has_risen() or self._loop.orders.order == HOME)

    def _has_result(self, command: float) -> bool:
        return int(command) in self._drone.command_results

    def _fly_path(self, corners_m: Sequence[Position]) -> None:
        """Fly the path, and wait at its end for the order `home`, which also ends the flight on the path."""
        loop, start_s, has_arrived = self._loop, time.monotonic(), False
        if loop.orders.order == GO:
            self._start_phase(ON_PATH)
        for _ in loop.iterate(lambda: point_on_path(corners_m, (time.monotonic() - start_s) * self._plan.speed_m_s)):
            if loop.orders.order == HOME:
                return
            if not has_arrived and _is_near(self._drone.position_m, corners_m[-1]):
                has_arrived = True
                self._start_phase(AT_PATH_END)

    def _fly_to_origin(self, origin: FlightOrigin) -> None:
        """Fly to the point above the origin."""
        drone = self._drone
        assert drone.last_position_m is not None, "the drone has taken off"
        position_m = drone.last_position_m
        above_m, start_s = origin.position_at(0.0, 0.0, position_m[2]), time.monotonic()
        path_m = [position_m, above_m]
        self._start_phase(RETURNING)
        self._loop.run_until(
            lambda: _is_near(drone.position_m, above_m) and drone.speed_m_s < _SLOW_M_S,
            set_point=lambda: point_on_path(path_m, (time.monotonic() - start_s) * self._plan.speed_m_s),
        )

    def _start_phase(self, phase: str) -> None:
        """Start a phase of the flight: set it for the lines of the flight log, and report it by `log_line`."""
        self._log.phase = phase
        log_line(phase)


def fly(plan: FlightPlan, stop_event: threading.Event) -> int:
    """Run the pilot, the guard or the rescue program of a flight; return the exit code.

    Raises:
        OSError: The connection or the liveness file cannot be opened.
    """
    try:
        if plan.rescues:
            rescue.rescue(plan)
        elif plan.guards:
            guard.FlightGuard(plan, stop_event).run()
        else:
            OffboardPilot(plan, stop_event).fly()
    except FlightError as error:
        log_line(f"error: {error}")
        return error.code
    return 0


def _fault_text(check: ArmingCheck) -> str:
    """Return the faults that prevent a flight, with their remedies; empty if there are none."""
    return "; ".join(f"{fault.what} ({fault.remedy})" for fault in check.faults() if fault.prevents_flight)


def _is_near(position_m: Position | None, goal_m: Position) -> bool:
    return position_m is not None and math.dist(position_m, goal_m) < _NEAR_M
