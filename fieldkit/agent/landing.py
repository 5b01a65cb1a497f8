"""Bring a drone down, in the modes in which that is ours to do, and report it."""

from __future__ import annotations

import math
import os
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Callable, Iterator

from fieldkit.agent.autopilot import AutopilotState
from fieldkit.agent.dialect import ARM
from fieldkit.agent.flying.talk import AutopilotTalk
from fieldkit.agent.mavlink_frames import ACCEPTED
from fieldkit.agent.px4 import Px4

LAPSED, REFUSED, TAKEN, CALLED_OFF, GONE, FENCED = 4, 5, 6, 7, 8, 9
"""Exit codes: the lease lapsed; the autopilot refused or was silent; another party flies the drone; the job was
ended; the other program of the flight does not run any more; the drone was beyond its fence."""

AGAIN_S = 0.4
"""A command without an answer is sent again after this time."""
ANSWERS_S = 5.0
"""An autopilot has this time to do what was commanded."""
_TURN_S = 0.1
_DOWN_S = 600.0
"""For this long a drone whose motors turn is commanded to come down."""
UNHEARD_S = 60.0
"""And for this long while its autopilot is not heard: a router or a line that is down may come back."""


class FlightError(Exception):
    """The flight does not go on; the text is for people.

    Args:
        code: Exit code.
        why: Why.
    """

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


def bring_down(
    talk: AutopilotTalk,
    how: str,
    led: Callable[[], bool],
    each_turn: Callable[[], None] = lambda: None,
) -> None:
    """Command a drone to `land` or `return`, and wait until its motors have stopped; if it does not return, it lands.

    Commands are sent only while `led` holds: while the drone is in a mode in which it is ours to bring down. A drone
    that lands or returns by itself already is only watched. An autopilot that is not heard may hear what it cannot
    answer, and its connection may come back: it counts as in its last reported mode, for `UNHEARD_S`. The log has an
    alarm as soon as it is not heard.

    Args:
        talk: The conversation with its autopilot.
        how: `land` or `return`.
        led: Whether the drone is in such a mode.
        each_turn: Called with each turn.

    Raises:
        FlightError: Another party flies the drone (`TAKEN`), its autopilot was not heard for `UNHEARD_S`, or its
            motors still turn after `_DOWN_S`.
    """
    drone, asked_s, began_s, warned = talk.drone, 0.0, time.monotonic(), False
    command = (drone.dialect or Px4()).bring_down(how)  # other families know the commands of PX4
    number = int(command[0])
    drone.answers.pop(number, None)
    while drone.armed:
        now_s = time.monotonic()
        if now_s > began_s + _DOWN_S:
            raise FlightError(REFUSED, f"the autopilot reports that its motors turn; it was commanded to {how}")
        if min(drone.silent_s, now_s - began_s) > UNHEARD_S:
            raise FlightError(REFUSED, f"no heartbeat of the autopilot for {UNHEARD_S:g} s")
        if not drone.alive and not warned:
            say(alarm(drone))
        warned = not drone.alive
        if led():
            if how == "return" and drone.alive and now_s > began_s + ANSWERS_S:
                say(f"land: it does not return ({drone.said})")
                bring_down(talk, "land", led, each_turn)
                return
            if now_s > asked_s:
                asked_s = now_s + AGAIN_S
                drone.command(*command)
                if drone.answers.get(number, ACCEPTED) != ACCEPTED:
                    drone.command(ARM, 0)  # refused in the air; on the ground it may refuse to land
        elif not drone.comes_down and (drone.dialect is not None or drone.answers.get(number) != ACCEPTED):
            raise FlightError(TAKEN, f"another party flies it, nothing more is sent ({drone.said})")
        each_turn()
        talk.turn(_TURN_S)


def alarm(drone: AutopilotState) -> str:
    """Return the alarm of a flight that ends without a landing: the last known state, and what a person can do."""
    where = "ITS POSITION IS UNKNOWN"
    if drone.last_place_m is not None:
        north_m, east_m, down_m = drone.last_place_m
        where = (
            f"LAST KNOWN {drone.unplaced_s:.0f} S AGO {north_m:.1f} M NORTH, {east_m:.1f} M EAST, {-down_m:.1f} M UP "
            "IN ITS LOCAL FRAME"
        )
    heard = "NO HEARTBEAT"
    if math.isfinite(drone.silent_s):
        heard = f"MODE {drone.mode_name}, LAST HEARTBEAT {drone.silent_s:.0f} S AGO"
    return f"ALARM: THE DRONE MAY STILL BE IN THE AIR. {where}, {heard}. {MANUAL_ACTION}"


MANUAL_ACTION = "TAKE IT OVER BY REMOTE CONTROL, OR COMMAND LAND OR RTL AT THE GROUND STATION."


@contextmanager
def unhurried(path: str) -> Iterator[None]:
    """Let a file exist while the body runs, if it is named and has room; see `FlightPlan.unhurried`."""
    if path:
        with suppress(OSError):
            Path(path).touch()
    try:
        yield
    finally:
        if path:
            with suppress(OSError):
                Path(path).unlink()


def say(text: str) -> None:
    """Write a line into the log; on a full disk it is lost, which is no reason to leave a drone in the air."""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{time.time():.3f} {text}\n".encode())
