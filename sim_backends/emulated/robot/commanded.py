"""Record of the last velocity command to a robot's base, read by the physics that moves the robot.

Only the standard library is imported, because the base process is imported under Debian's Python, too.
"""

from pathlib import Path
from typing import Final, NamedTuple

from sim_backends.emulated.robot.spec import STATE
from sim_backends.emulated.ros.slots import Record

COMMANDED: Final = Path(STATE, "commanded")
"""The file of the record in the robot."""


class Commanded(NamedTuple):
    """Velocity command.

    Attributes:
        time_ns: Time at which the base received it, by the monotonic clock.
        forward_m_s: Forward speed.
        turn_rad_s: Turn rate to the left.
    """

    time_ns: int
    forward_m_s: float
    turn_rad_s: float


class CommandedRecord(Record):
    """The record in a file, with one writer and any number of readers."""

    layout = "q2d"

    def write(self, commanded: Commanded) -> None:
        """Write a commanded velocity.

        Raises:
            OSError: There is no space for it.
        """
        self._slots.write(*commanded)

    def read(self) -> Commanded | None:
        """Return the last commanded velocity, or None if there is none.

        Raises:
            OSError: The file cannot be read.
        """
        values = self._slots.read()
        return None if values is None else Commanded(*values)
