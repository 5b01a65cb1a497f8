"""Records that the autopilot and the physics simulator of a drone exchange: commands, and the resulting flight."""

import math
from typing import Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.slots import Record

_COMMAND_LAYOUT: Final = "3q7d"
_FLIGHT_LAYOUT: Final = "3q10d"


class FlightCommand(NamedTuple):
    """A command of an autopilot.

    Attributes:
        time_ns: Its time, from the monotonic clock.
        path_start_ns: Start of the assigned path (`AssignedPath.start_ns`) that put the drone at the start of this
            flight. If the lab has assigned another path since, the command is invalid.
        powered: False if the rotors are off.
        velocity_m_s: Target velocity, east, north, up.
        yaw_rad: Target heading, from east towards north; None to keep the heading.
        acceleration_m_s2: Maximum commanded horizontal acceleration.
        climb_m_s2: Maximum commanded accelerations downwards and upwards.
    """

    time_ns: int
    path_start_ns: int
    powered: bool
    velocity_m_s: Vector
    yaw_rad: float | None
    acceleration_m_s2: float
    climb_m_s2: tuple[float, float]


class FlightCommandRecord(Record):
    """The last command, in a file with one writer and any number of readers."""

    layout = _COMMAND_LAYOUT

    def write(self, command: FlightCommand) -> None:
        """Write a command.

        Raises:
            OSError: There is no space for it.
        """
        yaw_rad = math.nan if command.yaw_rad is None else command.yaw_rad
        self._slots.write(
            command.time_ns,
            command.path_start_ns,
            int(command.powered),
            *command.velocity_m_s,
            yaw_rad,
            command.acceleration_m_s2,
            *command.climb_m_s2,
        )

    def read(self) -> FlightCommand | None:
        """Return the last command, or None if there is none.

        Raises:
            OSError: The file cannot be read.
        """
        values = self._slots.read()
        if values is None:
            return None
        time_ns, path_start_ns, powered, east, north, up, yaw_rad, acceleration_m_s2, down_m_s2, up_m_s2 = values
        return FlightCommand(
            time_ns,
            path_start_ns,
            bool(powered),
            (east, north, up),
            None if math.isnan(yaw_rad) else yaw_rad,
            acceleration_m_s2,
            (down_m_s2, up_m_s2),
        )


class FlightMotion(NamedTuple):
    """Motion of a drone that a physics simulator moves; the autopilot of the drone reads it.

    Attributes:
        time_ns: Its time, from the monotonic clock.
        path_start_ns: Start time of the path with which the lab last placed the drone.
        is_supported: True if the drone rests on the ground or on an obstacle.
        place_m: Position of its lowest point, metres east, north, up.
        velocity_m_s: Velocity, east, north, up.
        heading_rad: Heading, from east towards north.
        turn_rad_s: Turn rate to the left.
        roll_rad: Positive with its left side up.
        pitch_rad: Positive with its nose down.
    """

    time_ns: int
    path_start_ns: int
    is_supported: bool
    place_m: Vector
    velocity_m_s: Vector
    heading_rad: float
    turn_rad_s: float
    roll_rad: float
    pitch_rad: float


class FlightRecord(Record):
    """The last motion, in a file with one writer and any number of readers."""

    layout = _FLIGHT_LAYOUT

    def write(self, flight: FlightMotion) -> None:
        """Write the motion.

        Raises:
            OSError: There is no space for it.
        """
        self._slots.write(
            flight.time_ns,
            flight.path_start_ns,
            int(flight.is_supported),
            *flight.place_m,
            *flight.velocity_m_s,
            *flight[5:],  # heading, turn rate, roll and pitch
        )

    def read(self) -> FlightMotion | None:
        """Return the last motion, or None if there is none.

        Raises:
            OSError: The file cannot be read.
        """
        values = self._slots.read()
        if values is None:
            return None
        time_ns, path_start_ns, is_supported, *numbers = values
        place_m, velocity_m_s, angles = tuple(numbers[:3]), tuple(numbers[3:6]), numbers[6:]
        return FlightMotion(time_ns, path_start_ns, bool(is_supported), place_m, velocity_m_s, *angles)
