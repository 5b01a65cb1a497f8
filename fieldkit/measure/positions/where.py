"""Positions of robots while something was measured, as columns, by whoever tells them best.

What `fieldkit positions` gave counts before what steps recorded, and that before what the testbed knows.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.columns import Column, Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role, in_order
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Floats
from fieldkit.measure.evidence import track
from fieldkit.measure.positions import accounts, geodesy, recorded, trajectories
from fieldkit.measure.positions.accounts import Account, Accounts
from fieldkit.measure.positions.samples import WGS84, Samples
from fieldkit.measure.positions.trajectories import Trajectory

_ATTEMPTS: Final = "repeats"
"""Attempts' folders lie in the one of this name in their trial's."""


def measure(
    evidence: AttemptEvidence,
    declared: Sequence[Column],
    ends: tuple[Role, Role],
    times_ns: Collection[int],
) -> Measured:
    """Return the columns that say how far two robots were apart from the first of some times to the last.

    Args:
        evidence: What the attempt left.
        declared: The columns, `PREFIX_distance_start_m` and so on.
        ends: Who sends, by whose clock the times are, and who receives.
        times_ns: The times, nanoseconds since 1970 UTC.
    """
    try:
        told = given(evidence)
        if not told.robots.keys() & set(ends):
            return track.measure(evidence.read_or_none(track.read, track.FILE), declared, ends, times_ns)
        source, destination = of_two(evidence, ends)
    except EvidenceError as error:
        return Measured.nothing(declared, error.what)
    if not len(times_ns):
        return Measured.nothing(declared, "no packet has a time")
    ahead_ns = _ahead_ns(told, ends[0])
    start_ns, end_ns = int(min(times_ns)) - ahead_ns, int(max(times_ns)) - ahead_ns
    for role, trajectory in zip(ends, (source, destination), strict=True):
        if why := trajectory.unknown(start_ns, end_ns):
            what = f"what {told.robots[role].in_words} tells of the {role} {why}"
            return Measured.nothing(declared, what)
    found = trajectories.apart(source, destination, start_ns, end_ns)
    return Measured.of({column.name: getattr(found, column.name.partition("_")[2]) for column in declared}, "")


def distances_m(evidence: AttemptEvidence, ends: tuple[Role, Role]) -> Sequence[tuple[int, float | None]]:
    """Return how far two robots were apart, and from when on by the clock of the first, in ns since 1970 UTC.

    None where nobody knows: in a gap, or out of reach; empty where nobody knows at all.
    """
    try:
        told = given(evidence)
        if not told.robots.keys() & set(ends):
            return list(track.distances_m(evidence.read_or_none(track.read, track.FILE) or (), *ends))
        source, destination = of_two(evidence, ends)
    except EvidenceError:
        return ()
    ahead_ns, found = _ahead_ns(told, ends[0]), list[tuple[int, float | None]]()
    for at_ns, metres in zip(*trajectories.distances_m(source, destination), strict=True):
        since_ns = found[-1][0] - ahead_ns if found else int(at_ns)
        if any(trajectory.unknown(since_ns, int(at_ns)) for trajectory in (source, destination)):
            found.append((since_ns + ahead_ns + 1, None))
        found.append((int(at_ns) + ahead_ns, float(metres)))
    return found


def given(evidence: AttemptEvidence) -> Accounts:
    """Return who tells where robots were, beside the testbed: nobody, most often.

    Raises:
        EvidenceError: A file that says so is damaged.
    """
    return evidence.cached(_given)


def _given(evidence: AttemptEvidence) -> Accounts:
    own = evidence.read(accounts.read, accounts.FILE) if evidence.has(accounts.FILE) else Accounts()
    later = _trial(evidence)
    after = accounts.read(later / accounts.FILE) if later and (later / accounts.FILE).is_file() else Accounts()
    return Accounts({**own.robots, **after.robots}, own.clocks, own.heights or after.heights)


def _trial(evidence: AttemptEvidence) -> Path | None:
    """Return the folder of the trial that the attempt is of, None where it lies in none."""
    parent = evidence.folder.absolute().parent
    return parent.parent if parent.name == _ATTEMPTS else None


def in_words(evidence: AttemptEvidence) -> str | None:
    """Return who tells where robots were: `sender as placed, receiver /odom`; None where nobody does."""
    told = given(evidence).robots
    return ", ".join(f"{role} {told[role].in_words}" for role in in_order(told)) or None


def of_two(evidence: AttemptEvidence, ends: tuple[Role, Role]) -> tuple[Trajectory, Trajectory]:
    """Return the trajectories of two robots, by the laptop's clock, in one frame.

    Raises:
        EvidenceError: Nobody tells of one of them, what does cannot be read, or both are told in different frames.
    """
    return evidence.cached(_of_two, ends)


def _of_two(evidence: AttemptEvidence, ends: tuple[Role, Role]) -> tuple[Trajectory, Trajectory]:
    told = given(evidence)
    one, other = (samples_of(evidence, role) for role in ends)
    if one.frame != other.frame:
        what = f"the {ends[0]} {one.frame}, the {ends[1]} {other.frame}"
        raise EvidenceError(f"robots are not told of in one frame: {what}")
    if one.frame == WGS84:
        one_m, other_m = _on_earth_m(one, other, heights=told.heights)
    else:
        one_m, other_m = one.values, other.values
    return _trajectory(one, one_m, told.robots[ends[0]]), _trajectory(other, other_m, told.robots[ends[1]])


def _trajectory(samples: Samples, places_m: Floats, account: Account) -> Trajectory:
    if account.place is not None:
        return trajectories.standing(places_m[0])
    return Trajectory(samples.times_ns, places_m, round(account.gap_s * 1e9))


def samples_of(evidence: AttemptEvidence, role: Role) -> Samples:
    """Return what is known of one robot, its times by the laptop's clock.

    Raises:
        EvidenceError: Nobody tells of it, or what does cannot be read.
    """
    told = given(evidence)
    if (account := told.robots.get(role)) is None:
        raise EvidenceError(f"nobody tells where the {role} was")
    if account.place is not None:
        place = np.array([account.place], dtype=float)  # NaN for None
        return Samples(np.zeros(1, dtype=np.int64), place, account.frame)
    if account.topic:
        read = evidence.read(recorded.read_topic, account.file, account)
        moved = _shifted(read, -_ahead_ns(told, Role(account.clock) if account.clock else role))
        return moved if moved.yaws_rad is None else recorded.from_start(moved, account)
    folder = _trial(evidence)
    assert folder is not None  # such an account is a trial's
    return _shifted(_of_trial(folder / account.file), round(account.offset_s * 1e9))


def told_of(evidence: AttemptEvidence) -> Mapping[Role, Samples]:
    """Return what is known of each robot that somebody tells of beside the testbed, as far as it can be read."""
    found: dict[Role, Samples] = {}
    with suppress(EvidenceError):
        for role in given(evidence).robots:
            with suppress(EvidenceError):
                found[role] = samples_of(evidence, role)
    return found


def _shifted(samples: Samples, by_ns: int) -> Samples:
    return Samples(samples.times_ns + by_ns, samples.values, samples.frame, samples.yaws_rad)


def _of_trial(path: Path) -> Samples:
    """Return what a file of a trial tells, which all of its attempts ask."""
    try:
        status = path.stat()
    except OSError as error:
        raise EvidenceError(f"{path.name} cannot be read: {error.strerror}", where=str(path)) from error
    return _read(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _read(path: Path, _mtime_ns: int, _size_bytes: int) -> Samples:
    return recorded.read_file(path)


def _ahead_ns(told: Accounts, role: Role) -> int:
    """Return how far a robot's clock was ahead of the laptop's: not at all, where nobody asked."""
    return round(told.clocks[role].offset_s * 1e9) if role in told.clocks else 0


def ahead_ns(evidence: AttemptEvidence, role: Role) -> int:
    """Return how far a robot's clock was ahead of the laptop's; 0 if that was not measured. Raises as `given`."""
    return _ahead_ns(given(evidence), role)


def clock_error_s(evidence: AttemptEvidence) -> float | None:
    """Return the most that times of two robots can be wrong against each other; None where nobody asked for them."""
    errors = sorted(offset.error_s for offset in given(evidence).clocks.values())
    return sum(errors[-2:]) if errors else None


def _on_earth_m(one: Samples, other: Samples, *, heights: bool) -> tuple[Floats, Floats]:
    """Return places of two robots in metres; where heights do not count, or are not told, both are at the middle one.

    Raises:
        EvidenceError: Heights are to count, and are not told.
    """
    told_m = np.concatenate((one.values[:, 2], other.values[:, 2]))
    known_m = told_m[np.isfinite(told_m)]
    if heights and len(known_m) < len(told_m):
        raise EvidenceError("heights are to count, and are not told everywhere")
    middle_m = float(np.median(known_m)) if len(known_m) else 0.0

    def on_earth_m(samples: Samples) -> Floats:
        north, east, up_m = samples.values.T
        return geodesy.ecef_m(north, east, up_m if heights else np.full(len(up_m), middle_m))

    return on_earth_m(one), on_earth_m(other)
