"""Slow fading: what hedges, slopes and people add to a path or take from it, alike for paths near each other."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.radio.streams import Stream

Floats = NDArray[np.float64]

_WAVES: Final = 256


class Shadowing:
    """A Gaussian field over the plane, and the shadowing between any two points of it.

    The shadowing of a path is sigma (F(a) + F(b)) / sqrt(2), F being a field with mean 0, variance 1 and the
    autocorrelation exp(-d / d0) of Gudmundson (Electron. Lett. 27:2145, 1991); so it is the same in both directions,
    and paths with a common end are correlated (Agrawal and Patwari, IEEE Trans. Wirel. Commun. 8:5576, 2009). F is a
    sum of 256 plane waves whose wave numbers have the density of that autocorrelation in two dimensions, with the
    distribution 1 - 1 / sqrt(1 + (k d0)^2).

    Args:
        seed: Of the field.
        sigma_db: Standard deviation.
        decorrelation_m: d0, over which correlation falls to 1/e.
    """

    def __init__(self, seed: int, sigma_db: float, decorrelation_m: float) -> None:
        stream = Stream(seed, "shadowing")
        draws = np.array([stream.draw(number) for number in range(3 * _WAVES)]).reshape(3, _WAVES)
        wave_number = np.sqrt(1 / (1 - draws[0]) ** 2 - 1) / decorrelation_m
        angle = 2 * math.pi * draws[1]
        self._waves = np.stack((wave_number * np.cos(angle), wave_number * np.sin(angle)))
        self._phases = 2 * math.pi * draws[2]
        self._sigma_db = sigma_db

    def loss_db(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the extra loss, which may be below 0, of paths between points of shape (n, 3), in dB."""
        loss_db: Floats = self._sigma_db * (self._field(start_m) + self._field(end_m)) / math.sqrt(2)
        return loss_db

    def _field(self, places_m: Floats) -> Floats:
        field: Floats = np.cos(places_m[:, :2] @ self._waves + self._phases).sum(axis=1) * math.sqrt(2 / _WAVES)
        return field
