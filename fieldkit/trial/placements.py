"""Compare the recorded positions of robots with the placement that the plan asked for."""

from collections.abc import Iterator
from fnmatch import fnmatch
from itertools import combinations
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role, in_order
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.evidence import host
from fieldkit.measure.positions import where
from fieldkit.measure.positions.samples import WGS84
from fieldkit.measure.positions.trajectories import Trajectory
from fieldkit.steps.scene import Scene

DEPENDENT: Final = (
    "*distance_start_m",
    "*distance_m??_m",
    "*distance_mean_m",
    "*relative_speed_m_s",
    "*sender_speed_m_s",
)
"""Columns of positions, which are withheld where the record contradicts the plan."""

SATELLITE_M: Final = 15.0
"""Tolerance for positions by satellites: twice 7.5 m. A receiver under open sky is within 5 m in 95 % of cases
(gps.gov, GPS accuracy), one beside a wall is worse."""
TRACKER_M: Final = 2.0
"""Tolerance for all other positions: two robots, each 1 m from where it should be."""
SHARE: Final = 0.1
"""Added to both, of the planned distance: measured by paces, or drift of odometry."""


def contradiction(scene: Scene, evidence: AttemptEvidence) -> str | None:
    """Return why the recorded positions cannot be of the planned placement; None if they can.

    Robots begin an attempt at their places. So at some moment of it the recorded distance of two robots is the one
    that was planned, whatever moves later.
    """
    return next(_contradictions(scene, evidence), None)


def _contradictions(scene: Scene, evidence: AttemptEvidence) -> Iterator[str]:
    places_m = scene.places_m
    try:
        told = where.given(evidence).robots
    except EvidenceError:
        return
    for ends in combinations([role for role in in_order(told) if role in places_m], 2):
        try:
            source, destination = where.of_two(evidence, (ends[0], ends[1]))
            satellites = where.samples_of(evidence, ends[0]).frame == WGS84
        except EvidenceError:
            continue  # there are no distances then
        times_ns = _times_ns(evidence, ends[0], source, destination)
        recorded_m = np.linalg.norm(destination.at_m(times_ns) - source.at_m(times_ns), axis=1)
        planned_m = float(np.linalg.norm(np.subtract(places_m[ends[1]], places_m[ends[0]])))
        off_m = float(np.abs(recorded_m - planned_m).min())
        if off_m > (SATELLITE_M if satellites else TRACKER_M) + SHARE * planned_m:
            nearest_m = float(recorded_m[np.abs(recorded_m - planned_m).argmin()])
            planned = f"the {ends[0]} and the {ends[1]} were placed {planned_m:.1f} m apart"
            yield f"{planned}, and by the record of their positions they were {nearest_m:.1f} m apart"


def _times_ns(evidence: AttemptEvidence, role: Role, *trajectories: Trajectory) -> Ints:
    """Return the moments of the attempt at which two robots are compared, by the laptop's clock."""
    known = np.unique(np.concatenate([trajectory.times_ns for trajectory in trajectories]))
    states = [evidence.read_or_none(host.state, file(role)) for file in (host.before, host.after)]
    clocks = [state.clock for state in states if state is not None and state.clock is not None]
    if len(clocks) < len(states):
        return known
    ahead_ns = where.ahead_ns(evidence, role)
    first, last = clocks[0].first_ns - ahead_ns, clocks[1].last_ns - ahead_ns
    inside = known[(known > first) & (known < last)]
    return np.concatenate(((first,), inside, (last,)))


def is_dependent(column: str) -> bool:
    """Return whether a column is one of positions."""
    return any(fnmatch(column, pattern) for pattern in DEPENDENT)
