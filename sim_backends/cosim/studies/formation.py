"""How well the followers of a scenario keep their positions."""

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
    """The position errors of followers, as magnitudes in metres; nan if there are no followers of that kind.

    Attributes:
        spacing_mean_m: Error of the distance to the leader, mean over time and followers that drive.
        spacing_max_m: Its maximum.
        station_mean_m: Distance from the station above the leaders, mean over time and followers that fly.
        station_max_m: Its maximum.
        amplification: Largest ratio of the L2 norm of the acceleration of a follower that drives to that of its
            leader: up to 1, the row was string stable for the motion of its first vehicle. Accelerations are 0 before
                and
            after a change of speed, so unlike with speeds, the end of the run does not matter.
    """

    spacing_mean_m: float
    spacing_max_m: float
    station_mean_m: float
    station_max_m: float
    amplification: float


NO_FORMATION = Formation(*(math.nan,) * 5)
"""The formation of a scenario without followers."""


def has_followers(scenario: CosimScenario) -> bool:
    """Return True if an agent in a scenario follows another one."""
    return any(isinstance(plan.motion, FollowPlan) for plan in scenario.agents.values())


def formation(scenario: CosimScenario, tracks: Tracks) -> Formation:
    """Return how well followers kept their positions; `NO_FORMATION` if there are fewer than two samples.

    Args:
        scenario: The scenario with the followers.
        tracks: The positions of the agents.
    """
    if len(tracks.times_s) < 2:
        return NO_FORMATION
    spacing: list[Floats] = []
    station: list[Floats] = []
    ratios: list[float] = []
    for name, plan in scenario.agents.items():
        if not isinstance(plan.motion, FollowPlan):
            continue
        leaders = _places_m(tracks, plan.motion.leader)
        follower = _places_m(tracks, [name])
        if isinstance(limits(plan.robot), QuadrotorLimits):
            station.append(convoy.station_errors_m(leaders, follower[:, 0], plan.motion.distance))
        else:
            row = np.concatenate([leaders, follower], axis=1)
            errors_m = convoy.spacing_errors_m(tracks.times_s, row, plan.motion.distance, plan.motion.headway)
            spacing.append(errors_m[:, 0])
            ratios += _ratios(tracks.times_s, row)
    return Formation(*_mean_and_max(spacing), *_mean_and_max(station), max(ratios, default=math.nan))


def mean_formation(several: Sequence[Formation]) -> Formation:
    """Return the formations of several runs as one: means, or the largest of maxima.

    Args:
        several: At least one.
    """
    columns = {
        field.name: np.array([getattr(formation, field.name) for formation in several]) for field in fields(Formation)
    }
    return Formation(
        **{name: float(values.max() if "max" in name else values.mean()) for name, values in columns.items()}
    )


def _places_m(tracks: Tracks, names: Sequence[str]) -> Floats:
    return tracks.places_m[:, [tracks.names.index(name) for name in names]]


def _ratios(times_s: Floats, row_m: Floats) -> Iterator[float]:
    accelerations_m_s2: Floats = np.gradient(convoy.speeds_m_s(times_s, row_m), times_s, axis=0)
    ratios = convoy.amplifications(accelerations_m_s2)
    return (float(ratio) for ratio in ratios if not math.isnan(ratio))


def _mean_and_max(errors_m: Sequence[Floats]) -> tuple[float, float]:
    """Return the mean and the maximum of magnitudes; nan if there are none."""
    if not errors_m:
        return math.nan, math.nan
    magnitudes = np.abs(np.concatenate(errors_m))
    return float(magnitudes.mean()), float(magnitudes.max())
