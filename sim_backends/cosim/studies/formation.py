"""Computes the position errors of followers, and the string stability of convoys.

A convoy is string stable if disturbances do not grow along its row of vehicles.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from sim_backends.cosim.federates import PhysicsFederate
from sim_backends.cosim.scenario.agent_plans import FollowPlan
from sim_backends.cosim.scenario.agent_setup import limits_of
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.intervals import Floats
from sim_backends.physics.robot_limits import QuadrotorLimits
from sim_backends.world.motion import State


@dataclass(frozen=True)
class Tracks:
    """Positions of agents over time.

    Attributes:
        names: The agents.
        times_s: Times, shape (times,).
        positions_m: Positions in metres east, north, up, shape (times, agents, 3).
    """

    names: Sequence[str]
    times_s: Floats
    positions_m: Floats

    def distances_m(self, other: "Tracks") -> Floats:
        """Return the distance of each agent from its position in another run, shape (common times, agents)."""
        common_count = min(len(self.times_s), len(other.times_s))
        distances_m: Floats = np.linalg.norm(
            self.positions_m[:common_count] - other.positions_m[:common_count], axis=2
        )
        return distances_m


def tracks_of(states: Iterable[tuple[int, str, State]]) -> Tracks:
    """Return the tracks of recorded states; an agent without a state at a time has the position nan.

    Args:
        states: Time in nanoseconds, agent, state, in the order of time.
    """
    by_time: dict[int, dict[str, State]] = {}
    for at_ns, name, state in states:
        by_time.setdefault(at_ns, {})[name] = state
    return _tracks(np.array([*by_time], dtype=np.float64) / 1e9, [*by_time.values()])


def _tracks(times_s: Floats, samples: Sequence[Mapping[str, State]]) -> Tracks:
    names = tuple(dict.fromkeys(name for states in samples for name in states))
    positions_m = [
        [states[name].position_m if name in states else (math.nan,) * 3 for name in names] for states in samples
    ]
    return Tracks(names, times_s, np.array(positions_m, dtype=np.float64).reshape(len(samples), len(names), 3))


class SampledPhysics:
    """Physics whose states are sampled at equal intervals; sampling does not change the motion.

    Args:
        physics: The physics federate.
        interval_ns: Sampling interval; it is rounded up to whole physics steps.

    Attributes:
        step_ns: Time step of the physics federate.
        limits_m_s2: Acceleration limit of each agent.
        agents_disappear: True if agents may disappear during the run.
    """

    def __init__(self, physics: PhysicsFederate, interval_ns: int) -> None:
        self._physics = physics
        self._interval_ns = -(-interval_ns // physics.step_ns) * physics.step_ns  # rounded up
        self._next_ns = 0
        self._samples: list[Mapping[str, State]] = []
        self.step_ns = physics.step_ns
        self.limits_m_s2 = physics.limits_m_s2
        self.agents_disappear = getattr(physics, "agents_disappear", False)

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Advance the physics federate, and store the samples that are due."""
        while self._next_ns <= to_ns:
            self._samples.append(self._physics.advance(self._next_ns, commands))
            self._next_ns += self._interval_ns
            commands = {}
        return self._physics.advance(to_ns, commands)

    @property
    def tracks(self) -> Tracks:
        """The samples so far."""
        times_s = np.arange(len(self._samples), dtype=np.float64) * (self._interval_ns / 1e9)
        return _tracks(times_s, self._samples)


def speeds_m_s(times_s: Floats, positions_m: Floats) -> Floats:
    """Return the speeds of vehicles, by central differences.

    Args:
        times_s: Times, shape (times,).
        positions_m: Positions in metres east, north, up, shape (times, vehicles, 3).

    Returns:
        Shape (times, vehicles).
    """
    speeds: Floats = np.linalg.norm(np.gradient(positions_m, times_s, axis=0), axis=-1)
    return speeds


def spacing_errors_m(times_s: Floats, positions_m: Floats, standstill_m: float, headway_s: float) -> Floats:
    """Return the gap in front of each follower minus the desired gap, which is `standstill_m + headway_s v`.

    Args:
        times_s: Times, shape (times,).
        positions_m: Positions of the vehicles in their order in the row, shape (times, vehicles, 3).
        standstill_m: Desired gap at standstill.
        headway_s: Time headway.

    Returns:
        Shape (times, vehicles - 1).
    """
    gaps_m = np.linalg.norm(np.diff(positions_m, axis=1), axis=-1)
    errors: Floats = gaps_m - standstill_m - headway_s * speeds_m_s(times_s, positions_m)[:, 1:]
    return errors


def station_errors_m(positions_m: Floats, station_m: Floats, above_m: float) -> Floats:
    """Return the distance of a drone from its station, which is `above_m` above the centre of the vehicles.

    Args:
        positions_m: Positions of the vehicles, shape (times, vehicles, 3).
        station_m: Positions of the drone, shape (times, 3).
        above_m: Height of its station above them.

    Returns:
        Shape (times,).
    """
    errors: Floats = np.linalg.norm(station_m - positions_m.mean(axis=1) - (0.0, 0.0, above_m), axis=-1)
    return errors


def amplifications(signals: Floats) -> Floats:
    """Return the ratio of the L2 norm of each vehicle's signal to the norm for the vehicle ahead (amplification).

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


@dataclass(frozen=True)
class Formation:
    """The position errors of followers, as magnitudes in metres; nan if there are no followers of that kind.

    Attributes:
        spacing_mean_m: Error of the distance to the leader, mean over time and followers that drive.
        spacing_max_m: Its maximum.
        station_mean_m: Distance from the station above the leaders, mean over time and followers that fly.
        station_max_m: Its maximum.
        amplification: Largest ratio of the L2 norm of a driving follower's acceleration to the L2 norm of its
            leader's acceleration. It is at most 1 if the row was string stable for the motion of its first vehicle.
            Accelerations are 0 before and after a change of speed, so the end time of the run does not affect the
            ratio. It would affect a ratio of speeds.
    """

    spacing_mean_m: float
    spacing_max_m: float
    station_mean_m: float
    station_max_m: float
    amplification: float


_MIN_SAMPLES: Final = 2
"""Number of samples that are needed to compute a speed."""

NO_FORMATION = Formation(*(math.nan,) * 5)
"""The formation of a scenario without followers."""


def has_followers(scenario: CosimScenario) -> bool:
    """Return True if an agent in a scenario follows another one."""
    return any(isinstance(plan.motion, FollowPlan) for plan in scenario.agents.values())


def compute_formation(scenario: CosimScenario, tracks: Tracks) -> Formation:
    """Return the position errors of followers; `NO_FORMATION` if there are fewer than two samples.

    Args:
        scenario: The scenario with the followers.
        tracks: The positions of the agents.
    """
    if len(tracks.times_s) < _MIN_SAMPLES:
        return NO_FORMATION
    spacing_errors: list[Floats] = []
    station_errors: list[Floats] = []
    ratios: list[float] = []
    for name, plan in scenario.agents.items():
        if not isinstance(plan.motion, FollowPlan) or not {name, *plan.motion.leader} <= {*tracks.names}:
            continue
        row_m = _positions_m(tracks, [*plan.motion.leader, name])
        is_present = ~np.isnan(row_m).any(axis=(1, 2))
        if np.count_nonzero(is_present) < _MIN_SAMPLES:
            continue
        times_s, leaders, follower = tracks.times_s[is_present], row_m[is_present, :-1], row_m[is_present, -1:]
        if isinstance(limits_of(plan.robot), QuadrotorLimits):
            station_errors.append(station_errors_m(leaders, follower[:, 0], plan.motion.distance))
        else:
            row_m = row_m[is_present]
            errors_m = spacing_errors_m(times_s, row_m, plan.motion.distance, plan.motion.headway)
            spacing_errors.append(errors_m[:, 0])
            ratios += _ratios(times_s, row_m)
    return Formation(*_mean_and_max(spacing_errors), *_mean_and_max(station_errors), max(ratios, default=math.nan))


def mean_formation(formations: Sequence[Formation]) -> Formation:
    """Return the combined formation of several runs: the means of their values, and the largest of their maxima.

    Args:
        formations: At least one.
    """
    columns = {
        field.name: np.array([getattr(formation, field.name) for formation in formations])
        for field in fields(Formation)
    }
    return Formation(
        **{name: float(values.max() if "max" in name else values.mean()) for name, values in columns.items()}
    )


def _positions_m(tracks: Tracks, names: Sequence[str]) -> Floats:
    return tracks.positions_m[:, [tracks.names.index(name) for name in names]]


def _ratios(times_s: Floats, row_m: Floats) -> Iterator[float]:
    accelerations_m_s2: Floats = np.gradient(speeds_m_s(times_s, row_m), times_s, axis=0)
    ratios = amplifications(accelerations_m_s2)
    return (float(ratio) for ratio in ratios if not math.isnan(ratio))


def _mean_and_max(errors_m: Sequence[Floats]) -> tuple[float, float]:
    """Return the mean and the maximum of the magnitudes of errors; nan without errors."""
    if not errors_m:
        return math.nan, math.nan
    magnitudes = np.abs(np.concatenate(errors_m))
    return float(magnitudes.mean()), float(magnitudes.max())
