"""The rescue of a drone: lands it where neither its pilot nor its guard runs; fieldkit starts it from the laptop."""

from __future__ import annotations

import time
from contextlib import suppress

from fieldkit.agent.autopilot import GUARD, AutopilotState
from fieldkit.agent.flight_plan import FlightPlan
from fieldkit.agent.flying import liveness
from fieldkit.agent.flying.liveness import LivenessFile
from fieldkit.agent.flying.talk import AutopilotTalk
from fieldkit.agent.landing import MANUAL_ACTION, REFUSED, UNHEARD_S, FlightError, alarm, bring_down, say, unhurried

_TURN_S = 0.1
_WARNS_S = 4.0
"""An autopilot that is not heard for this time is reported."""


def rescue(plan: FlightPlan) -> None:
    """End the pilot and the guard, and bring the drone down if their flight still leads it; no order stops this.

    Args:
        plan: With the file of liveness that the pilot and the guard share.

    Raises:
        FlightError: The autopilot was not heard for `UNHEARD_S`, another party flies the drone, or it did not land.
        OSError: The file of liveness cannot be opened.
        ValueError: The connection is not the name of one.
    """
    for own in (liveness.PILOT, liveness.GUARD):
        LivenessFile(plan.liveness, own).end_other()
    say(f"{plan.abort}: neither the pilot nor the guard runs")
    end_s = time.monotonic() + UNHEARD_S
    with unhurried(plan.unhurried):
        talk = _opened(plan.connection, end_s)
        try:
            _wait_for_autopilot(talk, end_s)
            bring_down(talk, plan.abort, lambda: is_led(talk.drone))
        except FlightError:
            say(alarm(talk.drone))
            raise
        finally:
            talk.close()
    say("landed")


def is_led(drone: AutopilotState) -> bool:
    """Return whether the drone is in the mode of the flight, or in the failsafe that follows lost set-points.

    A person who takes the drone over ends the failsafe, also where the mode stays the same.
    """
    return drone.guided or (drone.failsafe and drone.dialect is not None and drone.dialect.waits(drone.mode))


def _opened(connection: str, end_s: float) -> AutopilotTalk:
    """Return the conversation with the autopilot, through a new link server where the old one does not run.

    Raises:
        FlightError: The connection cannot be opened until `end_s`.
        ValueError: It is not the name of a connection.
    """
    warned = False
    while time.monotonic() < end_s:
        with suppress(OSError):  # it is tried for seconds
            return AutopilotTalk(connection, component=GUARD)
        if not warned:
            say(f"ALARM: THE DRONE MAY STILL BE IN THE AIR. {connection} CANNOT BE OPENED. {MANUAL_ACTION}")
        warned = True
    raise FlightError(REFUSED, f"{connection} could not be opened in {UNHEARD_S:g} s")


def _wait_for_autopilot(talk: AutopilotTalk, end_s: float) -> None:
    warns_s = time.monotonic() + _WARNS_S
    while not talk.drone.alive:
        if time.monotonic() > end_s:
            raise FlightError(REFUSED, f"no heartbeat of the autopilot in {UNHEARD_S:g} s")
        if time.monotonic() > warns_s:
            say(alarm(talk.drone))
            warns_s = end_s
        talk.turn(_TURN_S)
