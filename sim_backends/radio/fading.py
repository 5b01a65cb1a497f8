"""Fading of links: fast by echoes, as ends or their surroundings move; slow by shadowing, from place to place."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.radio.random_streams import Stream
from sim_backends.world.shapes import Floats

_ECHOES: Final = 12

_WAVES: Final = 256


class Fading:
    """The gains of some links over time, each with mean 1: Rician with line of sight, Rayleigh without.

    A sum of 12 echoes from random directions with random phases, each turning with its Doppler shift f_d cos(alpha)
    (Clarke, Bell Syst. Tech. J. 47:957, 1968; Jakes 1974), beside a steady wave of K times their power. The
    correlation of the echoes is J0(2 pi f_d t) with f_d = v / wavelength, so the gain changes within about 0.4 / f_d.
    It is one gain for the whole channel: over some tens of metres outdoors echoes come less than 1/20 MHz = 50 ns
    late.

    Args:
        seed: Of the directions and phases.
        links: Names of each link; both directions of a link have the same gain.
        wavelength_m: Of the carrier.
    """

    def __init__(self, seed: int, links: Sequence[Sequence[str]], *, wavelength_m: float) -> None:
        streams = [Stream(seed, *names, "fading") for names in links]
        turns = np.array([[stream.draw(number) for number in range(2 * _ECHOES + 1)] for stream in streams])
        turns = turns.reshape(-1, 2 * _ECHOES + 1)
        # Directions spread evenly, each within its own sector, so that a dozen echoes have the moments of many.
        directions = 2 * math.pi / _ECHOES * (np.arange(_ECHOES) + turns[:, :_ECHOES])
        self._echo_cos = np.cos(directions)
        self._begin_rad = 2 * math.pi * turns[:, _ECHOES:-1]
        self._steady_cos = np.cos(2 * math.pi * turns[:, -1])
        self._turn_rad_per_m = 2 * math.pi / wavelength_m
        self._since_ns = np.zeros(len(links), dtype=np.int64)
        self._speed_m_s, self._phase_rad, self._k = np.zeros((3, len(links)))

    def use(self, now_ns: int, links: NDArray[np.int64], *, speed_m_s: Floats, k: Floats) -> None:
        """Let links, by index, go on with other relative speeds, and other ratios `k` of the steady waves' power."""
        self._phase_rad[links] = self._phase(now_ns, links)
        self._since_ns[links], self._speed_m_s[links], self._k[links] = now_ns, speed_m_s, k

    def gains(self, now_ns: int, links: NDArray[np.int64]) -> Floats:
        """Return the power gains at `now_ns` of the links of these indices."""
        phase, k = self._phase(now_ns, links), self._k[links]
        echoes = np.exp(1j * (phase[:, None] * self._echo_cos[links] + self._begin_rad[links])).sum(axis=1)
        steady = np.sqrt(k) * np.exp(1j * phase * self._steady_cos[links])
        gains: Floats = np.abs(steady + echoes / math.sqrt(_ECHOES)) ** 2 / (k + 1)
        return gains

    def _phase(self, now_ns: int, links: NDArray[np.int64]) -> Floats:
        turned: Floats = self._turn_rad_per_m * self._speed_m_s[links] * ((now_ns - self._since_ns[links]) * 1e-9)
        return self._phase_rad[links] + turned


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
