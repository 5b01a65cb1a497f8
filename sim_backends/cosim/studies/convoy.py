"""Measures of a convoy from the positions of its vehicles: spacing, station keeping and string stability."""

import math

import numpy as np

from sim_backends.cosim.studies.intervals import Floats


def speeds_m_s(times_s: Floats, places_m: Floats) -> Floats:
    """Return the speeds of vehicles, by central differences.

    Args:
        times_s: Times, shape (times,).
        places_m: Positions in metres east, north, up, shape (times, vehicles, 3).

    Returns:
        Shape (times, vehicles).
    """
    speeds: Floats = np.linalg.norm(np.gradient(places_m, times_s, axis=0), axis=-1)
    return speeds


def spacing_errors_m(times_s: Floats, places_m: Floats, standstill_m: float, headway_s: float) -> Floats:
    """Return how much the gap before each follower exceeds the desired one, which is `standstill_m + headway_s v`.

    Args:
        times_s: Times, shape (times,).
        places_m: Positions of the vehicles in their order in the row, shape (times, vehicles, 3).
        standstill_m: Desired gap at standstill.
        headway_s: Time headway.

    Returns:
        Shape (times, vehicles - 1).
    """
    gaps_m = np.linalg.norm(np.diff(places_m, axis=1), axis=-1)
    errors: Floats = gaps_m - standstill_m - headway_s * speeds_m_s(times_s, places_m)[:, 1:]
    return errors


def station_errors_m(places_m: Floats, station_m: Floats, above_m: float) -> Floats:
    """Return the distance of a drone from its station, which is `above_m` above the centre of the vehicles.

    Args:
        places_m: Positions of the vehicles, shape (times, vehicles, 3).
        station_m: Positions of the drone, shape (times, 3).
        above_m: Height of its station above them.

    Returns:
        Shape (times,).
    """
    errors: Floats = np.linalg.norm(station_m - places_m.mean(axis=1) - (0.0, 0.0, above_m), axis=-1)
    return errors


def amplifications(signals: Floats) -> Floats:
    """Return the amplification of a signal by each vehicle: the ratio of its L2 norm to that of the vehicle ahead.

    A convoy is string stable if no ratio is above 1 for any motion of the first vehicle: then a disturbance decays
    along the row (Ploeg, van de Wouw and Nijmeijer, "Lp string stability of cascaded systems", IEEE Trans. Control
    Syst. Technol. 22, 2014). The mean of each signal is subtracted; pass whole periods of a periodic signal.

    Args:
        signals: For example speeds, accelerations, or spacing errors, shape (times, vehicles).

    Returns:
        Shape (vehicles - 1,); nan behind a vehicle whose signal does not change.
    """
    norms = np.linalg.norm(signals - signals.mean(axis=0), axis=0)
    ratios: Floats = norms[1:] / np.where(norms[:-1] > 0, norms[:-1], math.nan)
    return ratios


def gain(rate_rad_s: Floats, *, delay_s: float, headway_s: float, gain_per_s: float) -> Floats:
    """Return |Gamma(jw)| of `programs.follow.FollowAtHeadway`; the formula is in that module.

    Args:
        rate_rad_s: Angular frequencies w, shape (n,).
        delay_s: Delay of received states.
        headway_s: Time headway.
        gain_per_s: Rate at which an error of the distance decays.
    """
    s = 1j * rate_rad_s
    extrapolated = s + gain_per_s * (1 + delay_s * s)
    magnitude: Floats = np.abs(extrapolated / ((headway_s * s + 1) * (s + gain_per_s)))
    return magnitude


def longest_delay_s(headway_s: float, gain_per_s: float) -> float:
    """Return the longest delay with which a row of `FollowAtHeadway` is string stable: sup |Gamma(jw)| is 1."""
    return (math.hypot(1.0, headway_s * gain_per_s) - 1) / gain_per_s
