"""How far a robot went by its own odometry, beside how far other sources of its position have it."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Floats
from fieldkit.measure.evidence import track
from fieldkit.measure.positions import geodesy, where
from fieldkit.measure.positions.samples import WGS84

DRIFT: Final = 0.1
"""Share of a way by which odometry drifts at most, on wheels that do not slip."""
PLACE_M: Final = 0.5
SATELLITE_M: Final = 10.0
"""What other sources are off by: a lab's robot that moves between two of its places, and a receiver of satellites,
5 m at each end of the way."""
_AROUND_NS: Final = 1_000_000_000


def contradiction(
    evidence: AttemptEvidence, role: Role, farthest_m: float, speed_m_s: float, during_ns: tuple[int, int] | None
) -> str | None:
    """Return why a robot cannot have been so far from its place; None if it can.

    Args:
        evidence: What the attempt left.
        role: The robot.
        farthest_m: Its distance by its own log.
        speed_m_s: How fast it went.
        during_ns: First and last time of that log, by the robot's clock; None if it has no times.
    """
    known_m = evidence.read_or_none(track.read, track.FILE) if evidence.has(track.FILE) else None
    if known_m is not None and during_ns is not None:
        places_m = [
            whereabouts.position_m
            for whereabouts in known_m
            if whereabouts.role is role
            and whereabouts.position_m is not None
            and during_ns[0] - _AROUND_NS <= whereabouts.utc_ns <= during_ns[1] + _AROUND_NS
        ]
        other_m = _from_first_m(np.array(places_m, dtype=float)) if len(places_m) > 1 else None
        least_m = PLACE_M + DRIFT * farthest_m + speed_m_s
        if other_m is not None and abs(other_m - farthest_m) > least_m:
            return f"it was {farthest_m:.1f} m from its place by its odometry, and {other_m:.1f} m by {track.FILE}"
    return _recorded(evidence, role, farthest_m)


def _recorded(evidence: AttemptEvidence, role: Role, farthest_m: float) -> str | None:
    """Return why what steps or people recorded of a robot's positions cannot be of such a way.

    It may be of more of the attempt than the way, so it may have the robot farther away, and not nearer.
    """
    try:
        account = where.given(evidence).robots.get(role)
        if account is None or account.place is not None:
            return None
        samples = where.samples_of(evidence, role)
    except EvidenceError:
        return None
    on_earth = samples.frame == WGS84
    north, east, up_m = samples.values.T
    places_m = geodesy.ecef_m(north, east, np.zeros(len(up_m))) if on_earth else samples.values
    other_m = _from_first_m(places_m)
    if farthest_m - other_m > (SATELLITE_M if on_earth else PLACE_M) + DRIFT * farthest_m:
        return f"it was {farthest_m:.1f} m from its place by its odometry, and {other_m:.1f} m by {account.in_words}"
    return None


def _from_first_m(places_m: Floats | Sequence[Sequence[float]]) -> float:
    """Return the largest distance from the first place, over the ground. Shape (n, 3)."""
    ground_m = np.asarray(places_m)
    return float(np.linalg.norm(ground_m - ground_m[0], axis=1).max())
