"""Antenna gains of stations with an attitude."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.radio.propagation.antenna_patterns import AntennaPattern, rotation
from sim_backends.world.motion import Attitude
from sim_backends.world.shapes import Floats

_RING: Final = 36
"""Number of horizontal directions for the mean gain of echoes."""


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
