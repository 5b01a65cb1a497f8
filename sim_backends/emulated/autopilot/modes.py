"""Flight modes of the emulated autopilots."""

from enum import Enum, auto
from typing import Final


class Mode(Enum):
    """A flight mode; each firmware has its own names: ArduCopter's GUIDED is PX4's OFFBOARD.

    STABILIZE, ALT_HOLD and POSHOLD are modes for a pilot with a remote control, which is not emulated. In the air the
    drone holds its position, as if the sticks were centred. On the ground it stays, as if the throttle were closed.
    BRAKE, which stops the drone in the air, is emulated in the same way.
    """

    TAKEOFF = auto()
    LOITER = auto()
    MISSION = auto()
    RTL = auto()
    HOMECOMING = auto()
    """Last phase of RTL: descent at home."""
    LAND = auto()
    OFFBOARD = auto()
    STABILIZE = auto()
    ALT_HOLD = auto()
    POSHOLD = auto()
    BRAKE = auto()


LANDING: Final = frozenset({Mode.LAND, Mode.HOMECOMING})
"""Modes in which the drone descends to the ground."""
RETURNING: Final = LANDING | {Mode.RTL}
"""Modes in which the drone returns home or descends to the ground."""
PILOTED: Final = frozenset({Mode.STABILIZE, Mode.ALT_HOLD, Mode.POSHOLD, Mode.BRAKE})
"""Modes in which the drone holds its position in the air and does not take off: the modes for a pilot, and BRAKE."""


def reported_mode(mode: Mode) -> Mode:
    """Return the mode that is reported to clients; a phase of a mode is reported as the whole mode."""
    return Mode.RTL if mode is Mode.HOMECOMING else mode
