"""States of the programs that move a robot, as the job script prints them, and their texts for the operator."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Final


class MotionState(StrEnum):
    """States of a robot after the order to stop, from best to worst.

    Except for `NOTHING`, they are also the states of its programs, with the names that the job script prints.

    Attributes:
        NOTHING: No program of fieldkit moves it; nothing is sent to it.
        IDLE: The program had not started to move the robot, and has exited (`CANCELLED` in `fieldkit.agent.orders`).
        STATIONARY: Its odometry shows no motion.
        LANDED: Its motors have stopped.
        ENDED: The program has exited and did not report that the robot is stationary or on the ground, or that it
            had not started to move the robot.
        LAND: A drone is landing at its position.
        RETURN: A drone is returning, and will then land.
        SILENT: The program received a signal and has not reported a state. A program that drives the robot was then
            killed.
        ALARM: The program cannot land its drone now: the autopilot sends no heartbeat, or a person or another program
            flies it.
    """

    NOTHING = "nothing"
    IDLE = "idle"
    STATIONARY = "stationary"
    LANDED = "landed"
    ENDED = "ended"
    LAND = "land"
    RETURN = "return"
    SILENT = "silent"
    ALARM = "alarm"


BY_SEVERITY: Final = tuple(MotionState)
UNCONFIRMED_STATES: Final = frozenset({MotionState.ENDED, MotionState.SILENT, MotionState.ALARM})
"""States in which a person must stop the robot, or check that it has stopped."""
DESCENDING_STATES: Final = frozenset({MotionState.LAND, MotionState.RETURN})

STATE_TEXTS: Final[Mapping[MotionState, str]] = {
    MotionState.NOTHING: "no program of fieldkit moves it; nothing was sent to it",
    MotionState.IDLE: "its program has exited; it had not started to move the robot",
    MotionState.STATIONARY: "stopped (stationary)",
    MotionState.LANDED: "stopped (on the ground)",
    MotionState.ENDED: "NOT CONFIRMED: stop it by hand; its program has exited and has not confirmed the stop",
    MotionState.LAND: "coming down (land)",
    MotionState.RETURN: "coming down (return)",
    MotionState.SILENT: "NOT CONFIRMED: stop it by hand; its program was signalled but has not confirmed the stop",
    MotionState.ALARM: "ALARM: IT MAY STILL BE IN THE AIR, AND ITS AUTOPILOT SENDS NO HEARTBEAT OR DOES NOT OBEY. "
    "TAKE IT OVER BY REMOTE CONTROL, OR COMMAND LAND OR RTL AT THE GROUND STATION",
}
