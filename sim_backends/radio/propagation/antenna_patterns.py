"""Antenna patterns: gains in directions relative to an antenna, and of stations with an attitude.

Directions are unit vectors, shape (n, 3). In the frame of a body they are forward, left, up.
"""

import math
from collections.abc import Mapping, Sequence
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

_RING: Final = 36
"""Number of horizontal directions for the mean gain of echoes."""


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


class StationGains:
    """The gains of stations, some of which have an antenna pattern, for their current attitudes.

    Args:
        names: Names of the stations.
        patterns: Pattern of each station; None if it is isotropic.
    """

    def __init__(self, names: Sequence[str], patterns: Sequence[AntennaPattern | None]) -> None:
        self._patterns = {index: pattern for index, pattern in enumerate(patterns) if pattern is not None}
        self._names = tuple(names)
        self._attitudes = dict.fromkeys(self._patterns, Attitude())
        self._rotations = {index: rotation(Attitude()) for index in self._patterns}
        self._echo_gains = np.ones(len(names))
        for index in self._patterns:
            self._echo_gains[index] = self._mean_horizontal_gain(index)

    def orient(self, attitudes: Mapping[str, Attitude]) -> list[int]:
        """Set the attitudes of stations, and return the indices of stations with a pattern whose attitude changed.

        Stations that are not named keep their attitude, which is initially level with the nose to the east.
        """
        changed = [
            index
            for index, attitude in self._attitudes.items()
            if attitudes.get(self._names[index], attitude) != attitude
        ]
        for index in changed:
            self._attitudes[index] = attitude = attitudes[self._names[index]]
            self._rotations[index] = rotation(attitude)
            self._echo_gains[index] = self._mean_horizontal_gain(index)
        return changed

    def direct_dbi(self, stations: NDArray[np.int64], to_m: Floats) -> Floats:
        """Return the gains of stations in the directions of these vectors of shape (n, 3), east, north, up."""
        gains_dbi = np.zeros(len(stations))
        for index in self._patterns:
            rows = np.flatnonzero(stations == index)
            if len(rows):
                gains_dbi[rows] = self._gains_dbi(index, to_m[rows])
        return gains_dbi

    def link_gains(
        self, first: NDArray[np.int64], second: NDArray[np.int64], path_m: Floats
    ) -> tuple[Floats, Floats]:
        """Return the gains of links for the direct path, and for the echoes, as ratios.

        Echoes arrive from all horizontal directions, as in `fading.Fading`, so their gain is the mean over these.

        Args:
            first: First ends of the links.
            second: Second ends.
            path_m: Vectors from the first to the second ends, shape (n, 3).
        """
        direct = 10 ** ((self.direct_dbi(first, path_m) + self.direct_dbi(second, -path_m)) / 10)
        return direct, self._echo_gains[first] * self._echo_gains[second]

    def _gains_dbi(self, index: int, to_m: Floats) -> Floats:
        length_m = np.linalg.norm(to_m, axis=1, keepdims=True)
        # Stations at the same place have no direction; forward is used.
        world = np.where(length_m > 0, to_m, self._rotations[index][:, 0]) / np.where(length_m > 0, length_m, 1.0)
        return self._patterns[index].gains_dbi(world @ self._rotations[index])

    def _mean_horizontal_gain(self, index: int) -> float:
        angles = 2 * math.pi / _RING * np.arange(_RING)
        ring = np.stack((np.cos(angles), np.sin(angles), np.zeros(_RING)), axis=1)
        return float(np.mean(10 ** (self._gains_dbi(index, ring) / 10)))
