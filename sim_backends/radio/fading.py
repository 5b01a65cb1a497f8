"""Fading of links: fast by echoes, as ends or their surroundings move; slow by shadowing, from place to place."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.radio.random_streams import RandomStream, first_draws
from sim_backends.world.shapes import Floats

_ECHOES: Final = 12

_WAVES: Final = 256


class Fading:
    """The gains of some links by where their ends are, each with mean 1: Rician with line of sight, Rayleigh without.

    A sum of 12 echoes, each leaving one end and reaching the other in a direction of its own, beside a steady wave of
    K times their power. Where an end goes, the phase of each echo turns with its way in the echo's direction, as a
    ring of scatterers around each end makes it (Akki and Haber, IEEE Trans. Veh. Technol. 35:2, 1986; Patel, Stuber
    and Pratt, IEEE Trans. Commun. 53:374, 2005). So the echoes' autocorrelation is J0(2 pi d / wavelength) over a way
    d of one end (Clarke, Bell Syst. Tech. J. 47:957, 1968), and the product of both where both go. What stirs around
    two that stand turns them alike, J0(2 pi v t / wavelength). It is one gain for the whole channel: over some tens
    of metres outdoors echoes come less than 1/20 MHz = 50 ns late.

    A gain depends on nothing but time and places, so whoever asks later, or more often, gets the same. Directions and
    phases of a link are drawn when it is asked for first: of n stations that do not all send, few of n^2 / 2 are.

    Args:
        seed: Of the directions and phases.
        names: Of the stations.
        ends: Indices of the first and second end of each link, shape (2, n); both directions have the same gain.
        wavelength_m: Of the carrier.
        stir_m_s: Speed of what moves around the ends.
    """

    def __init__(
        self, seed: int, names: Sequence[str], ends: NDArray[np.int64], *, wavelength_m: float, stir_m_s: float
    ) -> None:
        self._seed = seed
        self._names = names
        self._ends = ends
        self._rad_per_m = 2 * math.pi / wavelength_m
        self._stir_m_s = stir_m_s
        count = ends.shape[1]
        self._drawn = np.zeros(count, dtype=bool)
        # East and north of each echo at its first end, then at its second.
        self._directions = np.empty((count, 4, _ECHOES))
        self._stirred, self._begin_rad = np.empty((2, count, _ECHOES))

    def echoes(self, links: NDArray[np.int64]) -> "Echoes":
        """Return the echoes of the links of these indices."""
        undrawn = links[~self._drawn[links]]
        if len(undrawn):
            self._draw(np.unique(undrawn))
        return Echoes(
            self._rad_per_m, self._directions[links], self._stir_m_s * self._stirred[links], self._begin_rad[links]
        )

    def _draw(self, links: NDArray[np.int64]) -> None:
        names = [(self._names[one], self._names[other], "fading") for one, other in self._ends[:, links].T.tolist()]
        draws = first_draws(self._seed, names, 4 * _ECHOES).reshape(-1, 4, _ECHOES)
        leaving, reaching, stirred, begin = np.moveaxis(draws, 1, 0)
        # Directions spread evenly, each within its own sector, so that a dozen echoes have the moments of many; the
        # sectors of an echo at both ends, and of what stirs it, are paired by steps that have no divisor in common
        # with 12, so that none goes with another.
        sector = np.arange(_ECHOES)
        leaving_rad, reaching_rad = _angles(sector, leaving), _angles(5 * sector, reaching)
        self._directions[links] = np.stack(
            [turned(angle) for angle in (leaving_rad, reaching_rad) for turned in (np.cos, np.sin)], axis=1
        )
        self._stirred[links] = np.cos(_angles(7 * sector, stirred))
        self._begin_rad[links] = 2 * math.pi * begin
        self._drawn[links] = True


@dataclass(frozen=True)
class Echoes:
    """The echoes of some links.

    Attributes:
        rad_per_m: How far a phase turns per metre.
        directions: East and north of each echo at its first end, then at its second, shape (n, 4, 12).
        stirred_m_s: How fast what stirs makes each longer, shape (n, 12).
        begin_rad: Their phases at time 0 where all ends are at the origin, shape (n, 12).
    """

    rad_per_m: float
    directions: Floats
    stirred_m_s: Floats
    begin_rad: Floats

    def fades(
        self, start_m: Floats, end_m: Floats, velocities_m_s: tuple[Floats, Floats] | None, k: Floats, since_ns: int
    ) -> "Fades":
        """Return the gains over time of the links, whose ends go on as they do at `since_ns`.

        Args:
            start_m: Where their first ends are, shape (n, 3).
            end_m: Where their second ends are.
            velocities_m_s: How first and second ends move, each of shape (n, 3); None where all stand.
            k: Power of the steady wave over that of the echoes, shape (n,).
            since_ns: When the ends are where they are said to be.
        """
        way_m = _along(start_m, end_m, self.directions)
        steady_rad = self.rad_per_m * (end_m - start_m)
        rate_m_s = self.stirred_m_s
        square: tuple[Floats, ...] = (_dot(steady_rad, steady_rad),)
        if velocities_m_s is not None:
            rate_m_s = _along(*velocities_m_s, self.directions) + rate_m_s
            steady_rad_s = self.rad_per_m * (velocities_m_s[1] - velocities_m_s[0])
            square += _dot(2 * steady_rad, steady_rad_s), _dot(steady_rad_s, steady_rad_s)
        echoes_rad = self.rad_per_m * (way_m + since_ns * 1e-9 * self.stirred_m_s) + self.begin_rad
        return Fades(echoes_rad, self.rad_per_m * rate_m_s, square, k)


class Fades:
    """The gains of links whose ends move evenly.

    Args:
        echoes_rad: Phases of the echoes at the beginning, shape (n, 12).
        echoes_rad_s: How fast they turn.
        square: The square of the distance from end to end in radians of the carrier, shape (n,), at the beginning,
            and what it grows by with time and with the square of time, or neither where it stays.
        k: Power of the steady wave over that of the echoes, shape (n,).
    """

    def __init__(self, echoes_rad: Floats, echoes_rad_s: Floats, square: tuple[Floats, ...], k: Floats) -> None:
        self._echoes = echoes_rad, echoes_rad_s
        self._square = square
        self._steady = np.sqrt(k / (k + 1))
        self._share = 1 / np.sqrt(_ECHOES * (k + 1))

    def gains(self, after_s: float) -> Floats:
        """Return the power gains, shape (n,), at a time after, or shortly before, the beginning."""
        begin, rate = self._echoes
        turned_rad = begin + after_s * rate
        echoes = np.cos(turned_rad).sum(axis=1) + 1j * np.sin(turned_rad).sum(axis=1)
        square, *changes = self._square
        if changes:
            slope, bend = changes
            square = np.maximum(square + after_s * (slope + after_s * bend), 0.0)
        steady = self._steady * np.exp(1j * np.sqrt(square))
        gains: Floats = np.abs(steady + self._share * echoes) ** 2
        return gains


def _along(start: Floats, end: Floats, directions: Floats) -> Floats:
    """Return how far links' two ends are, or go, in the directions of their echoes, in all."""
    along: Floats = np.einsum("ld,lde->le", np.hstack((start[:, :2], end[:, :2])), directions)
    return along


def _dot(one: Floats, other: Floats) -> Floats:
    product: Floats = (one * other).sum(axis=1)
    return product


def _angles(sectors: NDArray[np.int64], within: Floats) -> Floats:
    """Return an angle in each of 12 sectors, by where it is within its own, on [0, 1)."""
    angles: Floats = 2 * math.pi / _ECHOES * (sectors % _ECHOES + within)
    return angles


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
        draws = RandomStream(seed, "shadowing").first(3 * _WAVES).reshape(3, _WAVES)
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
