"""Antenna patterns: gains in directions relative to an antenna.

Directions are unit vectors, shape (n, 3). In the frame of a body they are forward, left, up.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from fieldkit.config.antennas import AntennaOptions
from fieldkit.core.model import Vector
from sim_backends.world.motion import Attitude
from sim_backends.world.shapes import Floats

DIPOLE_DIRECTIVITY: Final = 1.6409
"""Largest gain of a half-wave dipole without losses, 4 / Cin(2 pi): Balanis, Antenna Theory, eq. 4-91; 2.15 dBi."""

NULL_DBI: Final = -30.0
"""Smallest gain of a dipole, an assumption: reflections at the robot fill the nulls of a real antenna."""


class AntennaPattern(Protocol):
    """The gain of an antenna by direction."""

    def gains_dbi(self, directions: Floats) -> Floats:
        """Return the gains, shape (n,), in directions relative to the body."""
        ...


@dataclass(frozen=True)
class Dipole(AntennaPattern):
    """A half-wave dipole.

    Attributes:
        axis: Direction of its wire.
    """

    axis: Vector

    def gains_dbi(self, directions: Floats) -> Floats:
        """Return 1.64 (cos(pi/2 cos t) / sin t)^2 at the angle t from the wire (Balanis, eq. 4-84), in dBi."""
        axis = np.array(self.axis) / math.hypot(*self.axis)
        cosine = np.clip(directions @ axis, -1.0, 1.0)
        sine_square = np.maximum(1.0 - cosine**2, 1e-12)
        gains = DIPOLE_DIRECTIVITY * np.cos(math.pi / 2 * cosine) ** 2 / sine_square
        gains_dbi: Floats = 10 * np.log10(np.maximum(gains, 10 ** (NULL_DBI / 10)))
        return gains_dbi


@dataclass(frozen=True)
class GainTable(AntennaPattern):
    """Measured gains, with bilinear interpolation in dB. The gains are constant beyond the first and last elevation.

    Attributes:
        elevations_deg: Elevations of the rows, ascending; 90 is up.
        azimuths_deg: Azimuths of the columns, from forward towards left, ascending within one turn.
        table_dbi: The gains.
        orientation_deg: Roll, pitch and yaw of the antenna relative to the body.
    """

    elevations_deg: tuple[float, ...]
    azimuths_deg: tuple[float, ...]
    table_dbi: tuple[tuple[float, ...], ...]
    orientation_deg: Vector

    def gains_dbi(self, directions: Floats) -> Floats:
        """Implement `AntennaPattern.gains_dbi`."""
        roll_rad, pitch_rad, yaw_rad = np.radians(self.orientation_deg).tolist()
        forward, left, up = (directions @ rotation(Attitude(yaw_rad, pitch_rad, roll_rad))).T
        row, row_share = _between(np.array(self.elevations_deg), np.degrees(np.arcsin(np.clip(up, -1.0, 1.0))))
        # The first column follows the last one after a full turn.
        first_deg = self.azimuths_deg[0]
        azimuths_deg = np.array([*self.azimuths_deg, first_deg + 360.0])
        azimuth_deg = first_deg + np.mod(np.degrees(np.arctan2(left, forward)) - first_deg, 360.0)
        column, column_share = _between(azimuths_deg, azimuth_deg)
        table_dbi = np.array(self.table_dbi)
        table_dbi = np.hstack((table_dbi, table_dbi[:, :1]))
        next_row = np.minimum(row + 1, len(table_dbi) - 1)
        lower_dbi, upper_dbi = (
            table_dbi[index, column] * (1 - column_share) + table_dbi[index, column + 1] * column_share
            for index in (row, next_row)
        )
        gains_dbi: Floats = lower_dbi * (1 - row_share) + upper_dbi * row_share
        return gains_dbi


def _between(edges: Floats, values: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the interval between two edges that contains each value, and the position of the value in it, 0 to 1."""
    if len(edges) == 1:
        return np.zeros(len(values), dtype=np.int64), np.zeros(len(values))
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    share: Floats = np.clip((values - edges[index]) / (edges[index + 1] - edges[index]), 0.0, 1.0)
    return index, share


def pattern_of(antenna: AntennaOptions | None) -> Dipole | GainTable | None:
    """Return the pattern of an antenna; None if it is isotropic."""
    if antenna is None or antenna.pattern == "isotropic":
        return None
    if antenna.pattern == "dipole":
        forward, left, up = map(float, antenna.axis)
        return Dipole((forward, left, up))
    roll_deg, pitch_deg, yaw_deg = map(float, antenna.orientation_deg)
    return GainTable(
        tuple(map(float, antenna.elevations_deg)),
        tuple(map(float, antenna.azimuths_deg)),
        tuple(tuple(map(float, row)) for row in antenna.gains_dbi),
        (roll_deg, pitch_deg, yaw_deg),
    )


def decode_pattern(fields: Mapping[str, Any]) -> Dipole | GainTable:
    """Return the pattern whose `dataclasses.asdict` is `fields`, perhaps with lists instead of tuples."""
    values = {name: _tuple(value) for name, value in fields.items()}
    return Dipole(**values) if "axis" in values else GainTable(**values)


def _tuple(value: Any) -> Any:  # noqa: ANN401 (numbers, or lists of them)
    return tuple(map(_tuple, value)) if isinstance(value, list | tuple) else value


def rotation(attitude: Attitude) -> Floats:
    """Return the matrix whose columns are the forward, left and up axes of a body: yaw after pitch after roll."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(angle), math.sin(angle)) for angle in attitude)
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )
