"""Positions of robots from the sources in `positions.json`, and a check of travelled distances.

If neither robot of a pair has such a source, the positions of the testbed are used.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.columns import Column, Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role, sort_roles
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Floats
from fieldkit.measure.evidence import track
from fieldkit.measure.positions import position_files, position_sources, trajectories
from fieldkit.measure.positions.position_columns import trial_folder
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.positions.samples import WGS84, Samples, ecef_m
from fieldkit.measure.positions.trajectories import Trajectory


def measure(
    evidence: AttemptEvidence,
    columns: Sequence[Column],
    ends: tuple[Role, Role],
    times_ns: Collection[int],
) -> Measured:
    """Return the columns of distance and speeds of two robots, from the earliest to the latest of several times.

    If neither robot has a source in `positions.json`, the positions of the testbed are used.

    Args:
        evidence: The attempt's evidence.
        columns: The columns, `PREFIX_distance_start_m` and so on.
        ends: Sender and receiver.
        times_ns: The times by the sender's clock, in nanoseconds since 1970 UTC.
    """
    try:
        sources = read_position_sources(evidence)
        if not sources.robots.keys() & set(ends):
            return track.measure(evidence.read_or_none(track.read, track.FILE), columns, ends, times_ns)
        source, destination = trajectories_of_pair(evidence, ends)
    except EvidenceError as error:
        return Measured.all_missing(columns, error.what)
    if not len(times_ns):
        return Measured.all_missing(columns, "no packet has a time")
    offset_ns = _offset_ns(sources, ends[0])
    start_ns, end_ns = int(min(times_ns)) - offset_ns, int(max(times_ns)) - offset_ns
    for role, trajectory in zip(ends, (source, destination), strict=True):
        if problem := trajectory.coverage_problem(start_ns, end_ns):
            reason = f"the positions of the {role} from {sources.robots[role].description} {problem}"
            return Measured.all_missing(columns, reason)
    separation = trajectories.separation_between(source, destination, start_ns, end_ns)
    values = {column.name: getattr(separation, column.name.partition("_")[2]) for column in columns}
    return Measured.from_optional(values, "")  # no value is None, so no reason is needed


def distances_m(evidence: AttemptEvidence, ends: tuple[Role, Role]) -> Sequence[tuple[int, float | None]]:
    """Return the distance of two robots over time, as (time, distance) pairs.

    Times are in nanoseconds since 1970 UTC by the first robot's clock. A gap in the positions is a pair without a
    distance (None). If neither robot has a source in `positions.json`, the positions of the testbed are used. There
    are no pairs if a source is missing or cannot be read, or if the frames of the robots differ.
    """
    try:
        sources = read_position_sources(evidence)
        if not sources.robots.keys() & set(ends):
            return list(track.distances_m(evidence.read_or_none(track.read, track.FILE) or (), *ends))
        source, destination = trajectories_of_pair(evidence, ends)
    except EvidenceError:
        return ()
    offset_ns, distances = _offset_ns(sources, ends[0]), list[tuple[int, float | None]]()
    for at_ns, distance_m in zip(*trajectories.distances_m(source, destination), strict=True):
        previous_ns = distances[-1][0] - offset_ns if distances else int(at_ns)
        if any(trajectory.coverage_problem(previous_ns, int(at_ns)) for trajectory in (source, destination)):
            distances.append((previous_ns + offset_ns + 1, None))  # the gap starts 1 ns after the previous pair
        distances.append((int(at_ns) + offset_ns, float(distance_m)))
    return distances


def read_position_sources(evidence: AttemptEvidence) -> PositionSources:
    """Return the sources of positions other than the testbed; most attempts have none.

    Raises:
        EvidenceError: A file with sources is damaged.
    """
    return evidence.cached(_read_sources)


def _read_sources(evidence: AttemptEvidence) -> PositionSources:
    attempt_sources = (
        evidence.read(position_sources.read, position_sources.FILE)
        if evidence.has(position_sources.FILE)
        else PositionSources()
    )
    trial = trial_folder(evidence)
    trial_sources = (
        position_sources.read(trial / position_sources.FILE)
        if trial and (trial / position_sources.FILE).is_file()
        else PositionSources()
    )
    return PositionSources(
        {**attempt_sources.robots, **trial_sources.robots},
        attempt_sources.clocks,
        attempt_sources.heights or trial_sources.heights,
    )


def sources_text(evidence: AttemptEvidence) -> str | None:
    """Return a text such as `sender as placed, receiver /odom`, or None if there are no sources.

    Raises the same errors as `read_position_sources`.
    """
    robots = read_position_sources(evidence).robots
    return ", ".join(f"{role} {robots[role].description}" for role in sort_roles(robots)) or None


def trajectories_of_pair(evidence: AttemptEvidence, ends: tuple[Role, Role]) -> tuple[Trajectory, Trajectory]:
    """Return the trajectories of two robots, with times by the laptop's clock, in one frame.

    Raises:
        EvidenceError: A robot has no source, a source cannot be read, or the frames differ.
    """
    return evidence.cached(_trajectories_of_pair, ends)


def _trajectories_of_pair(evidence: AttemptEvidence, ends: tuple[Role, Role]) -> tuple[Trajectory, Trajectory]:
    sources = read_position_sources(evidence)
    source, destination = (samples_of(evidence, role) for role in ends)
    if source.frame != destination.frame:
        frames = f"the {ends[0]} {source.frame}, the {ends[1]} {destination.frame}"
        raise EvidenceError(f"the positions of the robots are in different frames: {frames}")
    if source.frame == WGS84:
        source_m, destination_m = _ecef_m(source, destination, heights=sources.heights)
    else:
        source_m, destination_m = source.values, destination.values
    return _trajectory(source, source_m, sources.robots[ends[0]]), _trajectory(
        destination, destination_m, sources.robots[ends[1]]
    )


def _trajectory(samples: Samples, places_m: Floats, position_source: PositionSource) -> Trajectory:
    if position_source.place is not None:
        return trajectories.stationary(places_m[0])
    return Trajectory(samples.times_ns, places_m, round(position_source.gap_s * 1e9))


def samples_of(evidence: AttemptEvidence, role: Role) -> Samples:
    """Return the samples of one robot, with times by the laptop's clock. A fixed place is one sample at time 0.

    Raises:
        EvidenceError: The robot has no source, or the source cannot be read.
    """
    sources = read_position_sources(evidence)
    if (position_source := sources.robots.get(role)) is None:
        raise EvidenceError(f"there is no source for the position of the {role}")
    if position_source.place is not None:
        place = np.array([position_source.place], dtype=float)  # converts None to NaN
        return Samples(np.zeros(1, dtype=np.int64), place, position_source.frame)
    if position_source.topic:
        recorded_samples = evidence.read(position_files.read_topic, position_source.file, position_source)
        samples = _shifted(
            recorded_samples, -_offset_ns(sources, Role(position_source.clock) if position_source.clock else role)
        )
        return samples if samples.yaws_rad is None else position_files.to_placement_frame(samples, position_source)
    folder = trial_folder(evidence)
    assert folder is not None  # a source without place and topic is in the file of a trial
    return _shifted(_samples_in_trial(folder / position_source.file), round(position_source.offset_s * 1e9))


def readable_samples(evidence: AttemptEvidence) -> Mapping[Role, Samples]:
    """Return the samples of each robot that has a readable source other than the testbed."""
    samples_by_role: dict[Role, Samples] = {}
    with suppress(EvidenceError):
        for role in read_position_sources(evidence).robots:
            with suppress(EvidenceError):
                samples_by_role[role] = samples_of(evidence, role)
    return samples_by_role


def _shifted(samples: Samples, by_ns: int) -> Samples:
    return Samples(samples.times_ns + by_ns, samples.values, samples.frame, samples.yaws_rad)


def _samples_in_trial(path: Path) -> Samples:
    """Return the samples in a file of a trial. They are cached, because all attempts of the trial use this file.

    Raises the same errors as `position_files.read_file`.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise EvidenceError(f"{path.name} cannot be read: {error.strerror}", where=str(path)) from error
    return _read_cached(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _read_cached(path: Path, _mtime_ns: int, _size_bytes: int) -> Samples:
    return position_files.read_file(path)


def _offset_ns(sources: PositionSources, role: Role) -> int:
    """Return the offset of a robot's clock from the laptop's, positive if it is ahead; 0 if it was not measured."""
    return round(sources.clocks[role].offset_s * 1e9) if role in sources.clocks else 0


def clock_offset_ns(evidence: AttemptEvidence, role: Role) -> int:
    """Return the offset of a robot's clock from the laptop's, or 0 if unknown.

    Raises the same errors as `read_position_sources`.
    """
    return _offset_ns(read_position_sources(evidence), role)


def clock_error_s(evidence: AttemptEvidence) -> float | None:
    """Return the maximum error of a time difference between two robots; None if no clock offset was measured.

    It is the sum of the two largest errors of clock offsets. Raises the same errors as `read_position_sources`.
    """
    errors_s = sorted(offset.error_s for offset in read_position_sources(evidence).clocks.values())
    return sum(errors_s[-2:]) if errors_s else None


def _ecef_m(source: Samples, destination: Samples, *, heights: bool) -> tuple[Floats, Floats]:
    """Return ECEF positions of two robots in metres.

    If `heights` is False, the median of the known heights is used for all positions, or 0 if no height is known.

    Raises:
        EvidenceError: `heights` is True, and some heights are unknown.
    """
    heights_m = np.concatenate((source.values[:, 2], destination.values[:, 2]))
    known_heights_m = heights_m[np.isfinite(heights_m)]
    if heights and len(known_heights_m) < len(heights_m):
        raise EvidenceError("heights are required, but some positions have no height")
    median_m = float(np.median(known_heights_m)) if len(known_heights_m) else 0.0

    def place_m(samples: Samples) -> Floats:
        latitude_deg, longitude_deg, height_m = samples.values.T
        return ecef_m(latitude_deg, longitude_deg, height_m if heights else np.full(len(height_m), median_m))

    return place_m(source), place_m(destination)


DRIFT: Final = 0.1
"""Maximum drift of odometry as a share of the path, for wheels that do not slip."""
PLACE_M: Final = 0.5
SATELLITE_M: Final = 10.0
"""Maximum errors of a distance: `PLACE_M` with local positions, `SATELLITE_M` with a satellite receiver (5 m at each
end of the path)."""
_MARGIN_S: Final = 1.0
"""Time before and after a robot's log in which positions of the testbed are also used."""


def travel_contradiction(
    evidence: AttemptEvidence, role: Role, farthest_m: float, speed_m_s: float, log_span_ns: tuple[int, int] | None
) -> str | None:
    """Return the reason why a robot cannot have travelled `farthest_m` away from its start.

    None if no other source of its position contradicts the distance.

    Args:
        evidence: The attempt's evidence.
        role: The robot.
        farthest_m: Largest distance from the start according to the robot's log.
        speed_m_s: Commanded speed of the robot.
        log_span_ns: First and last time of the log by the robot's clock; None if the log has no times.
    """
    track_samples = evidence.read_or_none(track.read, track.FILE) if evidence.has(track.FILE) else None
    if track_samples is not None and log_span_ns is not None:
        places_m = [
            sample.position_m
            for sample in track_samples
            if sample.role is role
            and sample.position_m is not None
            and log_span_ns[0] - _MARGIN_S * 1e9 <= sample.utc_ns <= log_span_ns[1] + _MARGIN_S * 1e9
        ]
        track_m = _max_distance_m(np.array(places_m, dtype=float)) if len(places_m) > 1 else None
        tolerance_m = PLACE_M + DRIFT * farthest_m + speed_m_s * _MARGIN_S
        if track_m is not None and abs(track_m - farthest_m) > tolerance_m:
            track_text = f"{track_m:.1f} m according to {track.FILE}"
            return f"it was {farthest_m:.1f} m from its start according to its odometry, but {track_text}"
    return _recorded_contradiction(evidence, role, farthest_m)


def _recorded_contradiction(evidence: AttemptEvidence, role: Role, farthest_m: float) -> str | None:
    """Return the reason why recorded positions of a robot contradict the distance, or None if they do not.

    The recording may be longer than the movement. Therefore, only a smaller recorded distance is a contradiction.
    """
    try:
        position_source = read_position_sources(evidence).robots.get(role)
        if position_source is None or position_source.place is not None:
            return None
        samples = samples_of(evidence, role)
    except EvidenceError:
        return None
    is_geodetic = samples.frame == WGS84
    places_m = samples.values
    if is_geodetic:
        latitude_deg, longitude_deg, height_m = samples.values.T
        places_m = ecef_m(latitude_deg, longitude_deg, np.zeros(len(height_m)))
    recorded_m = _max_distance_m(places_m)
    if farthest_m - recorded_m > (SATELLITE_M if is_geodetic else PLACE_M) + DRIFT * farthest_m:
        recorded_text = f"{recorded_m:.1f} m according to {position_source.description}"
        return f"it was {farthest_m:.1f} m from its start according to its odometry, but {recorded_text}"
    return None


def _max_distance_m(places_m: Floats | Sequence[Sequence[float]]) -> float:
    """Return the largest distance from the first place. Shape of `places_m`: (n, 3)."""
    positions_m = np.asarray(places_m)
    return float(np.linalg.norm(positions_m - positions_m[0], axis=1).max())
