"""Bring a drone down, whatever speaks against it, and say so."""

from __future__ import annotations

import os
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Iterator

from fieldkit.agent.autopilot import AutopilotTalk
from fieldkit.agent.dialect import ARM
from fieldkit.agent.mavlink_frames import ACCEPTED
from fieldkit.agent.px4 import Px4

LAPSED, REFUSED, TAKEN, CALLED_OFF = 4, 5, 6, 7
"""Exit codes: the laptop was gone, the autopilot did not do it, somebody else flies it, it was told to end."""

AGAIN_S = 0.4
"""After so long without an answer a command is sent again."""
ANSWERS_S = 5.0
_TURN_S = 0.1
_TELLS_S = 30.0
"""So long one that is silent is told to come down: it may hear what it cannot answer."""
_DOWN_S = 600.0
"""And so long one that says that its motors turn."""


class FlightError(Exception):
    """It does not go on; the text is for people.

    Args:
        code: Exit code.
        why: Why.
    """

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


def bring_down(talk: AutopilotTalk, how: str) -> None:
    """Let it `land` or `return`, and wait until its motors stand; one that does not return lands.

    Raises:
        FlightError: It is silent, or its motors turn on: nobody knows what became of it.
    """
    drone, asked_s, began_s = talk.drone, 0.0, time.monotonic()
    command = (drone.dialect or Px4()).bring_down(how)  # others know the commands that PX4 does
    number = int(command[0])
    drone.answers.pop(number, None)
    while drone.armed:
        if time.monotonic() > began_s + (_DOWN_S if drone.alive else _TELLS_S):
            state = "says that its motors turn" if drone.alive else "is silent"
            raise FlightError(REFUSED, f"the autopilot {state}; it was told to {how}")
        does = drone.answers.get(number) == ACCEPTED and not drone.guided
        if not does and how == "return" and time.monotonic() > began_s + ANSWERS_S:
            say(f"land: it does not return: {drone.said or 'it does not say why'}")
            bring_down(talk, "land")
            return
        if not does and time.monotonic() > asked_s:
            asked_s = time.monotonic() + AGAIN_S
            drone.command(*command)
            if number in drone.answers:
                drone.command(ARM, 0)  # it stands on the ground, and so does not land; in the air it refuses this
        talk.turn(_TURN_S)


@contextmanager
def unhurried(path: str) -> Iterator[None]:
    """Let a file be there while the body runs, if it is named and has room; see `FlightPlan.unhurried`."""
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
