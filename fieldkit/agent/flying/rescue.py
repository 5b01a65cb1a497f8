"""A program that lands a drone if neither its pilot nor its guard runs. The laptop starts it."""

from __future__ import annotations

import time
from contextlib import suppress

from fieldkit.agent.autopilots.autopilot import GUARD, AutopilotState
from fieldkit.agent.flying import liveness
from fieldkit.agent.flying.flight_plan import FlightPlan
from fieldkit.agent.flying.landing import (
    MANUAL_ACTION,
    NO_HEARTBEAT_S,
    REFUSED,
    FlightError,
    alarm,
    bring_down,
    landing_marker,
    log_line,
)
from fieldkit.agent.flying.liveness import LivenessFile
from fieldkit.agent.flying.session import AutopilotSession

_POLL_S = 0.1
_ALARM_DELAY_S = 4.0
"""An alarm is logged after this time without a heartbeat."""


def rescue(plan: FlightPlan) -> None:
    """Land the drone if it is still under the control of the pilot and the guard (`is_under_control`).

    Both are killed first, so that a suspended one cannot continue. The file with the laptop's orders to the pilot is
    not read.

    Args:
        plan: A plan with the liveness file that the pilot and the guard share.

    Raises:
        FlightError: The connection could not be opened, or no heartbeat arrived, in `NO_HEARTBEAT_S`; a person or
            another program flies the drone; or it did not land.
        OSError: The liveness file cannot be opened.
        ValueError: The name of the connection is invalid.
    """
    for index in (liveness.PILOT, liveness.GUARD):
        LivenessFile(plan.liveness, own_index=index).kill_other()  # kills the program with the other entry
    log_line(f"{plan.abort}: neither the pilot nor the guard runs")
    deadline_s = time.monotonic() + NO_HEARTBEAT_S
    with landing_marker(plan.landing_marker):
        session = _open_session(plan.connection, deadline_s)
        try:
            _wait_for_autopilot(session, deadline_s)
            bring_down(session, plan.abort, lambda: is_under_control(session.drone))
        except FlightError:
            log_line(alarm(session.drone))
            raise
        finally:
            session.close()
    log_line("landed")


def is_under_control(drone: AutopilotState) -> bool:
    """Return True if the drone is in the mode of the flight, or in the failsafe for missing set-points.

    When a person takes the drone over, the failsafe ends, even if the mode stays the same.
    """
    return drone.guided or (
        drone.failsafe and drone.dialect is not None and drone.dialect.is_failsafe_hold(drone.mode)
    )


def _open_session(connection: str, deadline_s: float) -> AutopilotSession:
    """Open a session with the autopilot.

    If the link server (the process that shares the connection between programs) has stopped, a new one is started.

    Raises:
        FlightError: The connection cannot be opened before `deadline_s`.
        ValueError: The name of the connection is invalid.
    """
    has_warned = False
    while time.monotonic() < deadline_s:
        with suppress(OSError):  # each attempt may take several seconds
            return AutopilotSession(connection, component=GUARD)
        if not has_warned:
            log_line(f"ALARM: THE DRONE MAY STILL BE IN THE AIR. {connection} CANNOT BE OPENED. {MANUAL_ACTION}")
        has_warned = True
    raise FlightError(REFUSED, f"{connection} could not be opened in {NO_HEARTBEAT_S:g} s")


def _wait_for_autopilot(session: AutopilotSession, deadline_s: float) -> None:
    warning_s = time.monotonic() + _ALARM_DELAY_S
    while not session.drone.alive:
        if time.monotonic() > deadline_s:
            raise FlightError(REFUSED, f"no heartbeat from the autopilot in {NO_HEARTBEAT_S:g} s")
        if time.monotonic() > warning_s:
            log_line(alarm(session.drone))
            warning_s = deadline_s  # no second alarm
        session.exchange(_POLL_S)
