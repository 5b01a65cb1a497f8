"""Measures of a convoy, from where its vehicles were: spacing, station keeping and string stability."""

import math

import numpy as np

from sim_backends.cosim.studies.intervals import Floats


def speeds_m_s(times_s: Floats, places_m: Floats) -> Floats:
    """Return how fast vehicles were, by central differences.

    Args:
        times_s: When, shape (times,).
        places_m: Metres east, north, up, shape (times, vehicles, 3).

    Returns:
        Shape (times, vehicles).
    """
    speeds: Floats = np.linalg.norm(np.gradient(places_m, times_s, axis=0), axis=-1)
    return speeds


def spacing_errors_m(times_s: Floats, places_m: Floats, standstill_m: float, headway_s: float) -> Floats:
    """Return by how much each follower was farther behind than it should be, which is `standstill_m + headway_s v`.

    Args:
        times_s: When, shape (times,).
        places_m: Of the vehicles, each behind the one before it, shape (times, vehicles, 3).
        standstill_m: How far behind a vehicle stands.
        headway_s: Time by which it is behind.

    Returns:
        Shape (times, vehicles - 1).
    """
    gaps_m = np.linalg.norm(np.diff(places_m, axis=1), axis=-1)
    errors: Floats = gaps_m - standstill_m - headway_s * speeds_m_s(times_s, places_m)[:, 1:]
    return errors


def station_errors_m(places_m: Floats, station_m: Floats, above_m: float) -> Floats:
    """Return how far who holds station was from its place, `above_m` over the middle of the vehicles.

    Args:
        places_m: Of the vehicles, shape (times, vehicles, 3).
        station_m: Of who holds station, shape (times, 3).
        above_m: How far over them it should be.

    Returns:
        Shape (times,).
    """
    errors: Floats = np.linalg.norm(station_m - places_m.mean(axis=1) - (0.0, 0.0, above_m), axis=-1)
    return errors


def amplifications(signals: Floats) -> Floats:
    """Return by how much each vehicle amplifies what the one before it does: the ratio of the L2 norms of a signal.

    A convoy is string stable if none is above 1, whatever the first does: what disturbs one vehicle then dies out
    along the row (Ploeg, van de Wouw and Nijmeijer, "Lp string stability of cascaded systems", IEEE Trans. Control
    Syst. Technol. 22, 2014). Only what differs from a signal's mean counts; give it whole periods of what is periodic.

    Args:
        signals: For example speeds, accelerations, or spacing errors, shape (times, vehicles).

    Returns:
        Shape (vehicles - 1,); nan behind a vehicle whose signal does not change.
    """
    norms = np.linalg.norm(signals - signals.mean(axis=0), axis=0)
    ratios: Floats = norms[1:] / np.where(norms[:-1] > 0, norms[:-1], math.nan)
    return ratios


def gain(rate_rad_s: Floats, *, delay_s: float, headway_s: float, gain_per_s: float) -> Floats:
    """Return |Gamma(jw)| of `programs.follow.FollowAtHeadway`, whose module has the formula.

    Args:
        rate_rad_s: Angular frequencies w, shape (n,).
        delay_s: How long a state is under way.
        headway_s: Time by which it is behind.
        gain_per_s: By what an error of the distance shrinks.
    """
    s = 1j * rate_rad_s
    extrapolated = s + gain_per_s * (1 + delay_s * s)
    magnitude: Floats = np.abs(extrapolated / ((headway_s * s + 1) * (s + gain_per_s)))
    return magnitude


def longest_delay_s(headway_s: float, gain_per_s: float) -> float:
    """Return the longest delay with which a row of `FollowAtHeadway` is string stable: sup |Gamma(jw)| is 1."""
    return (math.hypot(1.0, headway_s * gain_per_s) - 1) / gain_per_s
