"""Compare the recorded positions of robots with the planned placement."""

from collections.abc import Iterator
from itertools import combinations
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role, sort_roles
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.evidence import host
from fieldkit.measure.positions import recorded_positions
from fieldkit.measure.positions.samples import WGS84
from fieldkit.measure.positions.trajectories import Trajectory
from fieldkit.steps.scene import Scene

SATELLITE_M: Final = 15.0
"""Tolerance for satellite positions: an error of 7.5 m at each robot. Under open sky, the error of a receiver is
below 5 m in 95 % of cases (gps.gov, GPS accuracy); next to a wall it is larger."""
TRACKER_M: Final = 2.0
"""Tolerance for other positions: each of two robots may be 1 m away from its planned place."""
SHARE: Final = 0.1
"""Share of the planned distance that is added to the tolerance. It allows for distances that were measured by
counting paces, and for drift of odometry."""


def contradiction(scene: Scene, evidence: AttemptEvidence) -> str | None:
    """Return the reason why the recorded positions contradict the planned placement, or None.

    Robots are at their places when an attempt starts, even if they move later. At some time of the attempt, the
    recorded distance of two robots must therefore equal the planned distance.
    """
    return next(_contradictions(scene, evidence), None)


def _contradictions(scene: Scene, evidence: AttemptEvidence) -> Iterator[str]:
    places_m = scene.places_m
    try:
        sources_by_role = recorded_positions.read_position_sources(evidence).robots
    except EvidenceError:
        return
    for pair in combinations([role for role in sort_roles(sources_by_role) if role in places_m], 2):
        try:
            source, destination = recorded_positions.trajectories_of_pair(evidence, (pair[0], pair[1]))
            is_satellite = recorded_positions.samples_of(evidence, pair[0]).frame == WGS84
        except EvidenceError:
            continue  # without positions there is no distance
        times_ns = _times_ns(evidence, pair[0], source, destination)
        recorded_m = np.linalg.norm(destination.at_m(times_ns) - source.at_m(times_ns), axis=1)
        planned_m = float(np.linalg.norm(np.subtract(places_m[pair[1]], places_m[pair[0]])))
        deviation_m = float(np.abs(recorded_m - planned_m).min())
        if deviation_m > (SATELLITE_M if is_satellite else TRACKER_M) + SHARE * planned_m:
            nearest_m = float(recorded_m[np.abs(recorded_m - planned_m).argmin()])
            planned_text = f"the planned distance of the {pair[0]} and the {pair[1]} is {planned_m:.1f} m"
            yield f"{planned_text}, but the distance of their recorded positions is {nearest_m:.1f} m"


def _times_ns(evidence: AttemptEvidence, role: Role, *trajectories: Trajectory) -> Ints:
    """Return the times at which the recorded distance of two robots is compared with the planned one.

    They are times of the laptop's clock, from the reading of a robot's state before the attempt to the reading after
    the attempt. If a reading is missing, they are all times at which a position was recorded.
    """
    times_ns = np.unique(np.concatenate([trajectory.times_ns for trajectory in trajectories]))
    states = [evidence.read_or_none(host.read_state, file(role)) for file in (host.before_file, host.after_file)]
    clocks = [state.clock for state in states if state is not None and state.clock is not None]
    if len(clocks) < len(states):
        return times_ns
    offset_ns = recorded_positions.clock_offset_ns(evidence, role)
    first, last = clocks[0].first_ns - offset_ns, clocks[1].last_ns - offset_ns
    inner_times_ns = times_ns[(times_ns > first) & (times_ns < last)]
    return np.concatenate(((first,), inner_times_ns, (last,)))
