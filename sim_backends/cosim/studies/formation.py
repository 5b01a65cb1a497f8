"""How well the followers of a scenario keep their place, from where agents were."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from sim_backends.cosim.scenario.motions import FollowPlan
from sim_backends.cosim.scenario.robots import limits
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies import convoy
from sim_backends.cosim.studies.intervals import Floats
from sim_backends.cosim.studies.tracks import Tracks
from sim_backends.physics.quadrotor import QuadrotorLimits


@dataclass(frozen=True)
class Formation:
    """How far followers were off their place, in metres and in magnitude; nan where nobody has such a place.

    Attributes:
        spacing_mean_m: Mean over time and followers that drive, of the error of the distance to their leader.
        spacing_max_m: Its maximum.
        station_mean_m: Mean over time and followers that fly, of the distance to their station over their leaders.
        station_max_m: Its maximum.
        amplification: The largest ratio of the L2 norm of the acceleration of one that drives to its leader's: the
            row was string stable for what its first did if it is not above 1. Accelerations are 0 before and after
            a change of speed, so that it does not matter when the run ends, unlike with speeds.
    """

    spacing_mean_m: float
    spacing_max_m: float
    station_mean_m: float
    station_max_m: float
    amplification: float


NOBODY = Formation(*(math.nan,) * 5)
"""Of a scenario in which nobody follows anybody."""


def has_followers(scenario: CosimScenario) -> bool:
    """Return whether somebody in a scenario steers by what it hears."""
    return any(isinstance(plan.motion, FollowPlan) for plan in scenario.agents.values())


def formation(scenario: CosimScenario, tracks: Tracks) -> Formation:
    """Return how well followers kept their place; of less than two looks at the agents, `NOBODY`.

    Args:
        scenario: Says who follows whom, and how.
        tracks: Where agents were.
    """
    if len(tracks.times_s) < 2:
        return NOBODY
    spacing: list[Floats] = []
    station: list[Floats] = []
    ratios: list[float] = []
    for name, plan in scenario.agents.items():
        if not isinstance(plan.motion, FollowPlan):
            continue
        leaders = _places_m(tracks, plan.motion.leader)
        own = _places_m(tracks, [name])
        if isinstance(limits(plan.robot), QuadrotorLimits):
            station.append(convoy.station_errors_m(leaders, own[:, 0], plan.motion.distance))
        else:
            row = np.concatenate([leaders, own], axis=1)
            errors_m = convoy.spacing_errors_m(tracks.times_s, row, plan.motion.distance, plan.motion.headway)
            spacing.append(errors_m[:, 0])
            ratios += _ratios(tracks.times_s, row)
    return Formation(*_size(spacing), *_size(station), max(ratios, default=math.nan))


def mean_formation(several: Sequence[Formation]) -> Formation:
    """Return the formations of several runs in one: means, but of maxima the largest.

    Args:
        several: At least one.
    """
    columns = {one.name: np.array([getattr(run, one.name) for run in several]) for one in fields(Formation)}
    return Formation(
        **{name: float(values.max() if "max" in name else values.mean()) for name, values in columns.items()}
    )


def _places_m(tracks: Tracks, names: Sequence[str]) -> Floats:
    return tracks.places_m[:, [tracks.names.index(name) for name in names]]


def _ratios(times_s: Floats, row_m: Floats) -> Iterator[float]:
    accelerations_m_s2: Floats = np.gradient(convoy.speeds_m_s(times_s, row_m), times_s, axis=0)
    found = convoy.amplifications(accelerations_m_s2)
    return (float(ratio) for ratio in found if not math.isnan(ratio))


def _size(errors_m: Sequence[Floats]) -> tuple[float, float]:
    """Return mean and maximum of magnitudes; nan of none."""
    if not errors_m:
        return math.nan, math.nan
    magnitudes = np.abs(np.concatenate(errors_m))
    return float(magnitudes.mean()), float(magnitudes.max())
