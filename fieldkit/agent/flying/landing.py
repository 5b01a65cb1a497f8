"""Land a drone, or let it return and land, if it is in a mode in which fieldkit controls it; report the result."""

from __future__ import annotations

import math
import os
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Callable, Iterator

from fieldkit.agent.autopilots.autopilot import AutopilotState, status_text
from fieldkit.agent.autopilots.dialect import ARM
from fieldkit.agent.autopilots.mavlink_frames import ACCEPTED
from fieldkit.agent.autopilots.px4 import Px4
from fieldkit.agent.flying.session import AutopilotSession

LEASE_EXPIRED, REFUSED, TAKEN_OVER, PEER_STOPPED, FENCE_BREACHED = 4, 5, 6, 8, 9
"""Exit codes: the lease expired (4); the autopilot refused a command or did not answer (5); a person or another
program flies the drone (6); the guard has stopped, or in the guard: the pilot has stopped (8); the drone was outside
its fence (9). `orders.CANCELLED` is 7."""

RETRY_S = 0.4
"""Retry interval of a command without an answer."""
COMMAND_TIMEOUT_S = 5.0
"""Maximum time until an autopilot executes a command, which is sent repeatedly."""
_POLL_S = 0.1
_MODE_WAIT_S = 0.3
"""Maximum wait for a heartbeat before the first command, because the last heartbeat may be older than a takeover by a
person."""
_LANDING_TIMEOUT_S = 600.0
"""Maximum time between a call of `bring_down` and the stop of the motors."""
NO_HEARTBEAT_S = 60.0
"""Time for which commands are sent although no heartbeat arrives, because a lost connection may be restored."""


class FlightError(Exception):
    """The flight cannot continue.

    Args:
        code: Exit code.
        reason: The reason, for the operator.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code


def bring_down(
    session: AutopilotSession,
    action: str,
    may_command: Callable[[], bool],
    each_iteration: Callable[[], None] = lambda: None,
) -> None:
    """Command a drone to `land` or `return`, and wait until its motors have stopped.

    If the drone does not obey the command `return` within `COMMAND_TIMEOUT_S`, it is commanded to land.

    Commands are sent only while `may_command` returns True: in the modes in which fieldkit controls the drone. Before
    the first command, it waits up to `_MODE_WAIT_S` for a new heartbeat, because the mode may have changed since the
    last one. A drone that lands or returns automatically, or whose unknown autopilot has accepted the command, is
    only monitored. An autopilot without heartbeats may still receive commands, and the connection may be restored:
    for `NO_HEARTBEAT_S` its last reported mode is assumed, and commands are sent. A missing heartbeat causes an alarm
    in the log.

    Args:
        session: The session with its autopilot.
        action: `land` or `return`.
        may_command: Returns True if the drone is in a mode in which fieldkit controls it.
        each_iteration: Called in each iteration.

    Raises:
        FlightError: A person or another program flies the drone (`TAKEN_OVER`), no heartbeat was received for
            `NO_HEARTBEAT_S`, or its motors are still running after `_LANDING_TIMEOUT_S`.
    """
    drone, retry_s, start_s, has_warned = session.drone, 0.0, time.monotonic(), False
    command = (drone.dialect or Px4()).bring_down_command(action)  # other families accept the commands of PX4
    command_id = int(command[0])
    drone.command_results.pop(command_id, None)
    _wait_for_mode(session, each_iteration)
    while drone.armed:
        now_s = time.monotonic()
        if now_s > start_s + _LANDING_TIMEOUT_S:
            raise FlightError(REFUSED, f"its motors are still running, although it was commanded to {action}")
        if min(drone.heartbeat_age_s, now_s - start_s) > NO_HEARTBEAT_S:
            raise FlightError(REFUSED, f"no heartbeat from the autopilot for {NO_HEARTBEAT_S:g} s")
        if not drone.alive and not has_warned:
            log_line(alarm(drone))
        has_warned = not drone.alive
        if may_command():
            if action == "return" and drone.alive and now_s > start_s + COMMAND_TIMEOUT_S:
                log_line(f"land: it does not return ({status_text(drone)})")
                bring_down(session, "land", may_command, each_iteration)
                return
            if now_s > retry_s:
                retry_s = now_s + RETRY_S
                drone.commands.send(*command)
                if drone.command_results.get(command_id, ACCEPTED) != ACCEPTED:
                    # An autopilot may refuse to land on the ground. It refuses to disarm in the air.
                    drone.commands.send(ARM, 0)
        elif not drone.lands_or_returns and (
            drone.dialect is not None or drone.command_results.get(command_id) != ACCEPTED
        ):
            raise FlightError(
                TAKEN_OVER, f"a person or another program flies it, so nothing more is sent ({status_text(drone)})"
            )
        each_iteration()
        session.exchange(_POLL_S)


def _wait_for_mode(session: AutopilotSession, each_iteration: Callable[[], None]) -> None:
    """Wait for the next heartbeat, which contains the current mode, but at most `_MODE_WAIT_S`."""
    start_s = time.monotonic()
    while session.drone.armed and time.monotonic() - start_s < min(session.drone.heartbeat_age_s, _MODE_WAIT_S):
        each_iteration()
        session.exchange(_POLL_S)
    session.exchange(0.0)  # a heartbeat may have arrived while this program did not run


def alarm(drone: AutopilotState) -> str:
    """Return the alarm text for a drone that may be in the air, with its last known state and what to do."""
    position_text = "ITS POSITION IS UNKNOWN"
    if drone.last_position_m is not None:
        north_m, east_m, down_m = drone.last_position_m
        position_text = (
            f"LAST POSITION {drone.position_age_s:.0f} S AGO: {north_m:.1f} M NORTH, {east_m:.1f} M EAST, "
            f"{-down_m:.1f} M UP IN ITS LOCAL FRAME"
        )
    heartbeat = "NO HEARTBEAT"
    if math.isfinite(drone.heartbeat_age_s):
        heartbeat = f"MODE {drone.mode_name}, LAST HEARTBEAT {drone.heartbeat_age_s:.0f} S AGO"
    return f"ALARM: THE DRONE MAY STILL BE IN THE AIR. {position_text}, {heartbeat}. {MANUAL_ACTION}"


MANUAL_ACTION = "TAKE IT OVER BY REMOTE CONTROL, OR COMMAND LAND OR RTL AT THE GROUND STATION."


@contextmanager
def landing_marker(path: str) -> Iterator[None]:
    """Create a marker file and remove it after the body; errors are ignored.

    Args:
        path: The file, see `FlightPlan.landing_marker`; empty to create none.
    """
    if path:
        with suppress(OSError):
            Path(path).touch()
    try:
        yield
    finally:
        if path:
            with suppress(OSError):
                Path(path).unlink()


def log_line(text: str) -> None:
    """Write a line to the log; errors are ignored, because a full disk must not prevent a landing."""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{time.time():.3f} {text}\n".encode())
