"""Check of the distance that a robot travelled by its odometry against other sources of its position."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Floats
from fieldkit.measure.evidence import track
from fieldkit.measure.positions import position_columns
from fieldkit.measure.positions.samples import WGS84, ecef_m

DRIFT: Final = 0.1
"""Upper limit of odometry drift as a share of the path, for wheels that do not slip."""
PLACE_M: Final = 0.5
SATELLITE_M: Final = 10.0
"""Position errors of other sources: a lab's robot that moves between two places, and a satellite receiver (5 m at
each end of the path)."""
_AROUND_NS: Final = 1_000_000_000


def contradiction(
    evidence: AttemptEvidence, role: Role, farthest_m: float, speed_m_s: float, during_ns: tuple[int, int] | None
) -> str | None:
    """Return the reason why a robot cannot have been that far from its place, or None if it can.

    Args:
        evidence: The attempt's evidence.
        role: The robot.
        farthest_m: Its largest distance by its log.
        speed_m_s: Its speed.
        during_ns: First and last time of that log by the robot's clock; None if it has no times.
    """
    track_samples = evidence.read_or_none(track.read, track.FILE) if evidence.has(track.FILE) else None
    if track_samples is not None and during_ns is not None:
        places_m = [
            sample.position_m
            for sample in track_samples
            if sample.role is role
            and sample.position_m is not None
            and during_ns[0] - _AROUND_NS <= sample.utc_ns <= during_ns[1] + _AROUND_NS
        ]
        other_m = _from_first_m(np.array(places_m, dtype=float)) if len(places_m) > 1 else None
        tolerance_m = PLACE_M + DRIFT * farthest_m + speed_m_s
        if other_m is not None and abs(other_m - farthest_m) > tolerance_m:
            return f"it was {farthest_m:.1f} m from its place by its odometry, and {other_m:.1f} m by {track.FILE}"
    return _recorded_contradiction(evidence, role, farthest_m)


def _recorded_contradiction(evidence: AttemptEvidence, role: Role, farthest_m: float) -> str | None:
    """Return the reason why recorded positions of a robot contradict the distance, or None.

    The recording may cover more of the attempt than the movement does. A larger recorded distance is therefore valid,
    a smaller one is not.
    """
    try:
        account = position_columns.position_accounts(evidence).robots.get(role)
        if account is None or account.place is not None:
            return None
        samples = position_columns.samples_of(evidence, role)
    except EvidenceError:
        return None
    on_earth = samples.frame == WGS84
    north, east, up_m = samples.values.T
    places_m = ecef_m(north, east, np.zeros(len(up_m))) if on_earth else samples.values
    other_m = _from_first_m(places_m)
    if farthest_m - other_m > (SATELLITE_M if on_earth else PLACE_M) + DRIFT * farthest_m:
        return (
            f"it was {farthest_m:.1f} m from its place by its odometry, and {other_m:.1f} m by {account.description}"
        )
    return None


def _from_first_m(places_m: Floats | Sequence[Sequence[float]]) -> float:
    """Return the largest distance from the first place. Shape (n, 3)."""
    ground_m = np.asarray(places_m)
    return float(np.linalg.norm(ground_m - ground_m[0], axis=1).max())
