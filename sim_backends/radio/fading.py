"""Fast fading: echoes that add up and cancel as the ends of a link move."""

import cmath
import math
from typing import Final

from sim_backends.radio.streams import Stream

_ECHOES: Final = 12


class Fading:
    """The gain of one link over time, with mean 1: Rician with line of sight, Rayleigh without.

    A sum of 12 echoes from random directions with random phases, each turning with its Doppler shift f_d cos(alpha)
    (Clarke, Bell Syst. Tech. J. 47:957, 1968; Jakes 1974), beside a steady wave of K times their power. The
    correlation of the echoes is J0(2 pi f_d t) with f_d = v / wavelength, so the gain changes within about 0.4 / f_d.
    It is one gain for the whole channel: over some tens of metres outdoors echoes come less than 1/20 MHz = 50 ns
    late.

    Args:
        seed: Of the directions and phases.
        name: Of the link; both directions have the same.
        wavelength_m: Of the carrier.
    """

    def __init__(self, seed: int, *name: str, wavelength_m: float) -> None:
        stream = Stream(seed, *name, "fading")
        turns = [2 * math.pi * stream.draw(number) for number in range(2 * _ECHOES + 1)]
        # Directions spread evenly, each within its own sector, so that a dozen echoes have the moments of many.
        sector = 2 * math.pi / _ECHOES
        directions = [sector * (n + turn / (2 * math.pi)) for n, turn in enumerate(turns[:_ECHOES])]
        self._echoes = tuple(zip((math.cos(one) for one in directions), turns[_ECHOES:-1], strict=True))
        self._steady_cos = math.cos(turns[-1])
        self._turn_rad_per_m = 2 * math.pi / wavelength_m
        self._speed_m_s = 0.0
        self._since_ns = 0
        self._phase_rad = 0.0
        self._k = 0.0

    def use(self, now_ns: int, *, speed_m_s: float, k: float) -> None:
        """Go on from `now_ns` with another relative speed, and another ratio `k` of the steady wave's power."""
        self._phase_rad = self._phase(now_ns)
        self._since_ns, self._speed_m_s, self._k = now_ns, speed_m_s, k

    def gain(self, now_ns: int) -> float:
        """Return the power gain at `now_ns`."""
        phase = self._phase(now_ns)
        echoes = sum(cmath.exp(1j * (phase * cos + begin)) for cos, begin in self._echoes)
        steady = math.sqrt(self._k) * cmath.exp(1j * phase * self._steady_cos)
        return abs(steady + echoes / math.sqrt(_ECHOES)) ** 2 / (self._k + 1)

    def _phase(self, now_ns: int) -> float:
        return self._phase_rad + self._turn_rad_per_m * self._speed_m_s * (now_ns - self._since_ns) * 1e-9
