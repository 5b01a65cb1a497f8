"""Columns of robots' positions during a measurement, from recorded positions or, without these, from the testbed."""

from collections.abc import Collection, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.columns import Column, Measured
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import track

POSITION_DEPENDENT_PATTERNS: Final = (
    "*distance_start_m",
    "*distance_min_m",
    "*distance_max_m",
    "*distance_mean_m",
    "*relative_speed_m_s",
    "*sender_speed_m_s",
)
"""Patterns of the columns that depend on positions."""

_ATTEMPTS: Final = "repeats"
"""Name of the folder in a trial that contains the attempts' folders."""


def measure(
    evidence: AttemptEvidence,
    columns: Sequence[Column],
    ends: tuple[Role, Role],
    times_ns: Collection[int],
) -> Measured:
    """Return the columns of distance and speeds of two robots, from the earliest to the latest of several times.

    Args:
        evidence: The attempt's evidence.
        columns: The columns, `PREFIX_distance_start_m` and so on.
        ends: Sender and receiver.
        times_ns: The times by the sender's clock, in nanoseconds since 1970 UTC.
    """
    if not are_recorded(evidence):
        return track.measure(evidence.read_or_none(track.read, track.FILE), columns, ends, times_ns)
    from fieldkit.measure.positions import recorded_positions  # noqa: PLC0415 (few attempts have recorded positions)

    return recorded_positions.measure(evidence, columns, ends, times_ns)


def distances_m(evidence: AttemptEvidence, ends: tuple[Role, Role]) -> Sequence[tuple[int, float | None]]:
    """Return the distance of two robots over time, as (time, distance) pairs.

    Times are in nanoseconds since 1970 UTC by the first robot's clock. A gap in the positions is a pair without a
    distance (None). There are no pairs if no positions are recorded, or if they cannot be compared.
    """
    if not are_recorded(evidence):
        return list(track.distances_m(evidence.read_or_none(track.read, track.FILE) or (), *ends))
    from fieldkit.measure.positions import recorded_positions  # noqa: PLC0415 (as above)

    return recorded_positions.distances_m(evidence, ends)


def are_recorded(evidence: AttemptEvidence) -> bool:
    """Return True if the attempt or its trial has a file that lists sources of positions besides the testbed."""
    trial = trial_folder(evidence)
    return evidence.has(laptop_files.POSITIONS) or (trial is not None and (trial / laptop_files.POSITIONS).is_file())


def trial_folder(evidence: AttemptEvidence) -> Path | None:
    """Return the folder of the attempt's trial, or None if the attempt is not in a trial."""
    parent = evidence.folder.absolute().parent
    return parent.parent if parent.name == _ATTEMPTS else None


def depends_on_positions(column: str) -> bool:
    """Return True if a column depends on positions."""
    return any(fnmatch(column, pattern) for pattern in POSITION_DEPENDENT_PATTERNS)
