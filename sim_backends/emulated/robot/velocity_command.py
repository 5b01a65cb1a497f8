"""Record of the last velocity command to a robot's base. The physics simulator that moves the robot reads it.

Only the standard library is imported, because programs under Debian's Python also import this module.
"""

from pathlib import Path
from typing import Final, NamedTuple

from sim_backends.emulated.robot.spec import STATE
from sim_backends.emulated.ros.slots import Record

VELOCITY_COMMAND: Final = Path(STATE, "commanded")
"""The file of the record in the robot."""


class VelocityCommand(NamedTuple):
    """A velocity command.

    Attributes:
        time_ns: Time at which the base received it, by the monotonic clock.
        forward_m_s: Forward speed.
        turn_rad_s: Turn rate to the left.
    """

    time_ns: int
    forward_m_s: float
    turn_rad_s: float


class VelocityCommandRecord(Record):
    """The record in a file, with one writer and any number of readers."""

    layout = "q2d"

    def write(self, command: VelocityCommand) -> None:
        """Write a command.

        Raises:
            OSError: There is no space for it.
        """
        self._slots.write(*command)

    def read(self) -> VelocityCommand | None:
        """Return the last command, or None if there is none.

        Raises:
            OSError: The file cannot be read.
        """
        values = self._slots.read()
        return None if values is None else VelocityCommand(*values)
