"""Mean path loss in the open, for arrays of paths."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.world.materials import GROUND, SPEED_OF_LIGHT_M_S
from sim_backends.world.shapes import Floats

NEAREST_M: Final = 1.0
"""At smaller distances the loss is constant, because far-field formulas do not apply near an antenna."""


def free_space_db(start_m: Floats, end_m: Floats, frequency_hz: float) -> Floats:
    """Return the loss in free space, 20 log10(4 pi d f / c), of paths of shape (n, 3): ITU-R P.525."""
    return _friis_db(_length_m(start_m, end_m), frequency_hz)


def log_distance_db(start_m: Floats, end_m: Floats, frequency_hz: float, exponent: float) -> Floats:
    """Return free-space loss at 1 m plus 10 n log10(d / 1 m): Rappaport, Wireless Communications, 4.9.1."""
    loss_db: Floats = 10 * exponent * np.log10(_length_m(start_m, end_m)) + _friis_db(np.ones(1), frequency_hz)
    return loss_db


def two_ray_db(start_m: Floats, end_m: Floats, frequency_hz: float) -> Floats:
    """Return the loss with ground reflection: the sum of the direct and the reflected wave, with their phases.

    Heights are over flat ground at 0. The reflection is Fresnel's for vertical polarization on medium dry ground
    (ITU-R P.2040-1, eq. 31b and table 3); see Rappaport, Wireless Communications, 4.5 and 4.6. When the two waves
    cancel, the loss exceeds the loss of the direct wave by at most 40 dB, because no real ground is flat enough for
    more.
    """
    direct_m = _length_m(start_m, end_m)
    image_m = end_m * np.array((1.0, 1.0, -1.0))
    reflected_m = _length_m(start_m, image_m)
    sine = np.minimum((start_m[:, 2] + end_m[:, 2]) / reflected_m, 1.0)
    phase = 2 * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * (reflected_m - direct_m)
    ratio = 1 + _reflection(sine, frequency_hz) * direct_m / reflected_m * np.exp(-1j * phase)
    loss_db: Floats = _friis_db(direct_m, frequency_hz) - 20 * np.log10(np.maximum(np.abs(ratio), 0.01))
    return loss_db


def _reflection(sine: Floats, frequency_hz: float) -> NDArray[np.complex128]:
    """Return the reflection coefficient of the ground for a wave that arrives at an angle with this sine."""
    permittivity = GROUND.permittivity(frequency_hz)
    root = np.sqrt(permittivity - (1 - sine**2))
    reflection: NDArray[np.complex128] = (permittivity * sine - root) / (permittivity * sine + root)
    return reflection


def _length_m(start_m: Floats, end_m: Floats) -> Floats:
    length_m: Floats = np.maximum(np.linalg.norm(end_m - start_m, axis=1), NEAREST_M)
    return length_m


def _friis_db(length_m: Floats, frequency_hz: float) -> Floats:
    loss_db: Floats = 20 * np.log10(4 * math.pi * length_m * frequency_hz / SPEED_OF_LIGHT_M_S)
    return loss_db
