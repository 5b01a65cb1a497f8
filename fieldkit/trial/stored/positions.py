"""Positions of robots that are added after a trial, such as GPX tracks. They are stored with its evidence."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core import files
from fieldkit.core.columns import Measured
from fieldkit.core.errors import ConfigurationError, EvidenceError, did_you_mean
from fieldkit.core.model import Role, Status
from fieldkit.core.units import format_bytes, parse_offset_m
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.positions import position_files, position_sources, recorded_positions
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.positions.samples import LOCAL, WGS84
from fieldkit.trial import gates, journal, manifest, store
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans, verification
from fieldkit.trial.stored.rebuild import RebuildResult, rebuild

MAX_BYTES: Final = 64 << 20
"""Maximum size of a position file: one day at 10 Hz as GPX."""


@dataclass(frozen=True)
class AttemptPositions:
    """The position columns of one attempt.

    Attributes:
        attempt: Name of the attempt's folder.
        source: Sources of the positions as text, such as `sender as placed, receiver /odom`; None if the only source,
            if any, is the testbed.
        distances_m: Smallest and largest distance by measurement, such as `transfer`, `rtt` or `up.rtt`.
        missing: Reasons for missing distances, by measurement.
    """

    attempt: str
    source: str | None
    distances_m: Mapping[str, tuple[float, float]]
    missing: Mapping[str, str]


def set_positions(
    folder: Path, sources: Mapping[Role, Path | PositionSource], *, offset_s: float, gap_s: float, heights: bool
) -> RebuildResult:
    """Store positions of robots with a trial, replace positions that were added before, and rebuild its tables.

    Args:
        folder: The trial's folder.
        sources: GPX or CSV file, or a fixed place, by role; empty to remove positions that were added before.
        offset_s: Offset that is added to the times of the files to convert them to the laptop's clock, in seconds.
        gap_s: Longest time between two points over which positions are interpolated linearly, in seconds.
        heights: True to use the heights of positions in degrees as well; False for horizontal distances of such
            positions. The heights of positions in metres are always used.

    Raises:
        ConfigurationError: `folder` is not a trial, another process runs the trial, the trial has no such role, a
            file is missing or too large, or a number is too large.
        EvidenceError: A file is not a valid GPX or CSV file, or the trial's evidence has changed.
    """
    plan = plans.read_plan(folder)
    for role, source in sources.items():
        _require_role(plan, role)
        if isinstance(source, Path):
            _require_file(source)
            position_files.read_file(source)
        times = PositionSource(offset_s=offset_s, gap_s=gap_s)
        if not position_sources.is_valid(times if isinstance(source, Path) else source):
            raise ConfigurationError(
                f"the position of {role} has a number that is too large",
                remedy="check the units of its place, of --offset and of --gap",
            )
    # Position files that were added before are replaced, so their changes do not matter.
    changes = {
        name: change for name, change in verification.differences(folder).items() if not manifest.is_positions(name)
    }
    if changes:
        problem = f"the evidence has changed since it was measured: {verification.summarize(changes)}"
        raise EvidenceError(problem, where=str(folder), remedy="restore it from a copy")
    with journal.locked(folder):
        sources_by_role = {
            role: _store_source(folder, role, source, offset_s, gap_s) for role, source in sources.items()
        }
        if sources_by_role:
            text = position_sources.text(PositionSources(sources_by_role, heights=heights))
            files.write(folder / position_sources.FILE, text.encode())
        else:
            (folder / position_sources.FILE).unlink(missing_ok=True)
        _remove_others(folder, {source.file for source in sources_by_role.values()})
        if (folder / store.MANIFEST_FILE).exists():
            manifest.Manifest(folder).renew_positions()
    return rebuild(folder)


def _require_role(plan: Plan, role: Role) -> None:
    if role not in plan.cast:
        remedy = did_you_mean(role, plan.cast, f"roles of the trial: {', '.join(plan.cast)}")
        raise ConfigurationError(f"the trial has no role {role}", remedy=remedy)


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise ConfigurationError(
            "there is no such file", where=str(path), remedy="name a GPX or CSV file, or a place: 48.1,11.5"
        )
    if (size_bytes := path.stat().st_size) > MAX_BYTES:
        problem = f"it has {format_bytes(size_bytes)}, but the limit is {format_bytes(MAX_BYTES)}"
        raise ConfigurationError(problem, where=str(path), remedy="remove the points outside of the trial")


def _store_source(
    folder: Path, role: Role, source: Path | PositionSource, offset_s: float, gap_s: float
) -> PositionSource:
    """Copy the position file of a robot into the trial's folder and return it as a position source.

    A fixed place is returned unchanged.
    """
    if isinstance(source, PositionSource):
        return source
    name = f"{store.POSITIONS}{role}{source.suffix.lower()}"
    with source.open("rb") as content, files.replacing(folder / name) as copy:
        shutil.copyfileobj(content, copy)
    return PositionSource(file=name, offset_s=offset_s, gap_s=gap_s)


def _remove_others(folder: Path, names: set[str]) -> None:
    for path in folder.glob(f"{store.POSITIONS}*"):
        if path.name not in names:
            path.unlink()


def parse_source(text: str) -> tuple[Role, Path | PositionSource]:
    """Return a role and the position source of its robot.

    Examples are `receiver=walk.gpx`, `sender=48.1,11.5` (latitude and longitude) and `sender=0m,5m` (along two axes).
    A third number is the height in metres; after degrees, it is the height above the ellipsoid.

    Raises:
        ConfigurationError: The text does not have this form.
    """
    name, separator, source = text.partition("=")
    try:
        role = Role(name)
    except ValueError:
        separator = ""
    if not separator or not source:
        problem = f"{text[:80]!r} is not ROLE=FILE or ROLE=PLACE"
        raise ConfigurationError(problem, remedy="write for example receiver=walk.gpx or sender=0m,5m")
    return role, _place(source) or Path(source)


def _place(text: str) -> PositionSource | None:
    """Return a fixed place, or None if the text is not a place."""
    try:
        (first, first_is_length), (second, is_length), *third = map(_degrees_or_m, text.split(","))
    except ValueError:
        return None
    is_in_range = is_length or (abs(first) <= 90 and abs(second) <= 180)
    if first_is_length is not is_length or not is_in_range or len(third) > 1:
        return None
    # Without a third number, a place in metres is at height 0, and the height of other places is unknown.
    height_m = third[0][0] if third else 0.0 if is_length else None
    return PositionSource(place=(first, second, height_m), frame=LOCAL if is_length else WGS84)


def _degrees_or_m(text: str) -> tuple[float, bool]:
    """Return the value of a number without a unit and False, or a length in metres and True.

    Raises `ValueError` for any other text.
    """
    with suppress(ValueError):
        return float(text), False
    try:
        return parse_offset_m(text.strip()), True
    except ConfigurationError as error:
        raise ValueError from error


def attempt_positions(folder: Path) -> Iterator[AttemptPositions]:
    """Yield the position columns of each valid attempt of a trial, measured again.

    Raises:
        ConfigurationError: `folder` is not a trial.
        EvidenceError: The journal is damaged.
    """
    plan = plans.read_plan(folder)
    for attempt in journal.ended_attempts(journal.history(folder, plan)):
        if attempt.status is Status.VALID:
            evidence = AttemptEvidence(store.attempt_folder(folder, attempt.folder))
            measured = gates.judge(plan, attempt.repeat, evidence).measured
            yield AttemptPositions(
                attempt.folder,
                recorded_positions.sources_text(evidence),
                dict(_distances_m(measured)),
                _missing(measured),
            )


_MIN_DISTANCE_SUFFIX: Final = "_distance_min_m"


def _distances_m(measured: Measured) -> Iterator[tuple[str, tuple[float, float]]]:
    for name, minimum_m in measured.values.items():
        if name.endswith(_MIN_DISTANCE_SUFFIX):
            measurement = name.removesuffix(_MIN_DISTANCE_SUFFIX)
            yield measurement, (float(minimum_m), float(measured.values[f"{measurement}_distance_max_m"]))


def _missing(measured: Measured) -> Mapping[str, str]:
    return {
        name.removesuffix(_MIN_DISTANCE_SUFFIX): reason
        for name, reason in measured.missing.items()
        if name.endswith(_MIN_DISTANCE_SUFFIX)
    }
