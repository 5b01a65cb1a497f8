"""Fading of links: fast by multipath while the ends or the scatterers move, slow by shadowing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.radio.core.random_streams import RandomStream, first_draws
from sim_backends.world.shapes import Floats

_ECHOES: Final = 12
"""Number of multipath components of a link."""

_WAVES: Final = 256
"""Number of plane waves in the shadowing field."""


class Fading:
    """Power gains of links for positions of their ends: Rician with line of sight, Rayleigh without. Their mean is 1.

    A gain is the sum of 12 multipath components (echoes), each with its own directions of departure and arrival, and
    a constant component of K times their power. When an end moves, the phase of each echo changes with the distance
    moved in the echo's direction, as in the model of a ring of scatterers around each end (Akki and Haber, IEEE
    Trans. Veh. Technol. 35:2, 1986; Patel, Stuber and Pratt, IEEE Trans. Commun. 53:1876, 2005). The autocorrelation
    of the echoes is therefore J0(2 pi d / wavelength) over a distance d moved by one end (Clarke, Bell Syst. Tech. J.
    47:957, 1968). If both ends move, it is the product of the J0 of each end. Moving scatterers around two ends at
    rest give the same kind of autocorrelation, J0(2 pi v t / wavelength). One gain applies to the whole channel: over
    some tens of metres outdoors, echoes arrive less than 1/20 MHz = 50 ns late.

    A gain depends only on time and positions, not on the number or order of calls. Directions and phases of a link
    are drawn when the link is first used: if few of n stations send, few of the n^2 / 2 links are needed.

    Args:
        seed: Seed of the directions and phases.
        names: Names of the stations.
        ends: Indices of the first and second end of each link, shape (2, n); both directions have the same gain.
        wavelength_m: Wavelength of the carrier.
        stir_m_s: Speed of the moving scatterers around the ends.
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
        self._is_drawn = np.zeros(count, dtype=bool)
        # East and north components of each echo's direction at its first end, then at its second.
        self._directions = np.empty((count, 4, _ECHOES))
        self._stir_cosines, self._initial_rad = np.empty((2, count, _ECHOES))

    def echoes(self, links: NDArray[np.int64]) -> "Echoes":
        """Return the echoes of the links with these indices."""
        new_links = links[~self._is_drawn[links]]
        if len(new_links):
            self._draw(np.unique(new_links))
        return Echoes(
            self._rad_per_m,
            self._directions[links],
            self._stir_m_s * self._stir_cosines[links],
            self._initial_rad[links],
        )

    def _draw(self, links: NDArray[np.int64]) -> None:
        names = [
            (self._names[first], self._names[second], "fading") for first, second in self._ends[:, links].T.tolist()
        ]
        draws = first_draws(self._seed, names, 4 * _ECHOES).reshape(-1, 4, _ECHOES)
        departure, arrival, stir, phase = np.moveaxis(draws, 1, 0)
        # Directions are spread evenly, one per sector, so that 12 echoes have the statistical moments of many. The
        # sectors of departure, arrival and scatterer motion are paired by step widths that have no common divisor
        # with 12, so that the three directions of an echo are independent.
        sector = np.arange(_ECHOES)
        departure_rad, arrival_rad = _angles(sector, departure), _angles(5 * sector, arrival)
        self._directions[links] = np.stack(
            [function(angle) for angle in (departure_rad, arrival_rad) for function in (np.cos, np.sin)], axis=1
        )
        self._stir_cosines[links] = np.cos(_angles(7 * sector, stir))
        self._initial_rad[links] = 2 * math.pi * phase
        self._is_drawn[links] = True


@dataclass(frozen=True)
class Echoes:
    """The multipath components (echoes) of some links.

    Attributes:
        rad_per_m: Phase change per metre.
        directions: East and north components of each echo's direction at its first end, then at its second, shape (n,
            4, 12).
        stir_rates_m_s: Rate at which moving scatterers lengthen each echo's path, shape (n, 12).
        initial_rad: Phases at time 0 with all ends at the origin, shape (n, 12).
    """

    rad_per_m: float
    directions: Floats
    stir_rates_m_s: Floats
    initial_rad: Floats

    def fades(
        self, start_m: Floats, end_m: Floats, velocities_m_s: tuple[Floats, Floats] | None, k: Floats, since_ns: int
    ) -> "Fades":
        """Return the gains of the links over time, for ends that keep their velocities.

        Args:
            start_m: Positions of the first ends, shape (n, 3).
            end_m: Positions of the second ends, shape (n, 3).
            velocities_m_s: Velocities of the first and second ends, each of shape (n, 3); None if all ends are at
                rest.
            k: Power ratio of the constant component and the echoes, shape (n,).
            since_ns: Time at which the ends have the given positions.
        """
        path_m = _projections(start_m, end_m, self.directions)
        steady_rad = self.rad_per_m * (end_m - start_m)
        rate_m_s = self.stir_rates_m_s
        square: tuple[Floats, ...] = (_dot(steady_rad, steady_rad),)
        if velocities_m_s is not None:
            rate_m_s = _projections(*velocities_m_s, self.directions) + rate_m_s
            steady_rad_s = self.rad_per_m * (velocities_m_s[1] - velocities_m_s[0])
            square += _dot(2 * steady_rad, steady_rad_s), _dot(steady_rad_s, steady_rad_s)
        echoes_rad = self.rad_per_m * (path_m + since_ns * 1e-9 * self.stir_rates_m_s) + self.initial_rad
        return Fades(echoes_rad, self.rad_per_m * rate_m_s, square, k)


class Fades:
    """The gains of links whose ends move with constant velocities.

    Args:
        echoes_rad: Phases of the echoes at the reference time, shape (n, 12).
        echoes_rad_s: Phase rates of the echoes.
        square: The squared distance between the ends in radians of the carrier, shape (n,), at the reference time;
            followed by its coefficients of time and of squared time, unless all ends are at rest.
        k: Power ratio of the constant component and the echoes, shape (n,).
    """

    def __init__(self, echoes_rad: Floats, echoes_rad_s: Floats, square: tuple[Floats, ...], k: Floats) -> None:
        self._echoes = echoes_rad, echoes_rad_s
        self._square = square
        self._steady = np.sqrt(k / (k + 1))
        self._share = 1 / np.sqrt(_ECHOES * (k + 1))

    def gains(self, after_s: float) -> Floats:
        """Return the power gains, shape (n,), at `after_s`, which is relative to the reference time."""
        initial_rad, rate_rad_s = self._echoes
        phases_rad = initial_rad + after_s * rate_rad_s
        echoes = np.cos(phases_rad).sum(axis=1) + 1j * np.sin(phases_rad).sum(axis=1)
        square, *changes = self._square
        if changes:
            linear, quadratic = changes
            square = np.maximum(square + after_s * (linear + after_s * quadratic), 0.0)
        steady = self._steady * np.exp(1j * np.sqrt(square))
        gains: Floats = np.abs(steady + self._share * echoes) ** 2
        return gains


def _projections(start: Floats, end: Floats, directions: Floats) -> Floats:
    """Return the sum of both ends' projections (of positions or velocities) on the directions of the echoes."""
    along: Floats = np.einsum("ld,lde->le", np.hstack((start[:, :2], end[:, :2])), directions)
    return along


def _dot(left: Floats, right: Floats) -> Floats:
    product: Floats = (left * right).sum(axis=1)
    return product


def _angles(sectors: NDArray[np.int64], within: Floats) -> Floats:
    """Return an angle in each of 12 sectors, at the fraction `within` [0, 1) of the sector."""
    angles: Floats = 2 * math.pi / _ECHOES * (sectors % _ECHOES + within)
    return angles


class Shadowing:
    """A Gaussian random field over the plane, and the shadowing between any two of its points.

    The shadowing of a path is sigma (F(a) + F(b)) / sqrt(2), where F is a field with mean 0, variance 1 and the
    autocorrelation exp(-d / d0) of Gudmundson (Electron. Lett. 27:2145, 1991); it is the same in both directions, and
    paths with a common end are correlated (Agrawal and Patwari, IEEE Trans. Wirel. Commun. 8:4024, 2009). F is a sum
    of 256 plane waves. Their wave numbers k follow the spectral density of that autocorrelation in two dimensions,
    with the cumulative distribution 1 - 1 / sqrt(1 + (k d0)^2).

    Args:
        seed: Seed of the field.
        sigma_db: Standard deviation.
        decorrelation_m: d0, the distance over which correlation falls to 1/e.
    """

    def __init__(self, seed: int, sigma_db: float, decorrelation_m: float) -> None:
        draws = RandomStream(seed, "shadowing").first(3 * _WAVES).reshape(3, _WAVES)
        wave_number = np.sqrt(1 / (1 - draws[0]) ** 2 - 1) / decorrelation_m
        angle = 2 * math.pi * draws[1]
        self._waves = np.stack((wave_number * np.cos(angle), wave_number * np.sin(angle)))
        self._phases = 2 * math.pi * draws[2]
        self._sigma_db = sigma_db

    def loss_db(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the extra loss, which may be negative, of paths between points of shape (n, 3), in dB."""
        loss_db: Floats = self._sigma_db * (self._field(start_m) + self._field(end_m)) / math.sqrt(2)
        return loss_db

    def _field(self, positions_m: Floats) -> Floats:
        field: Floats = np.cos(positions_m[:, :2] @ self._waves + self._phases).sum(axis=1) * math.sqrt(2 / _WAVES)
        return field
