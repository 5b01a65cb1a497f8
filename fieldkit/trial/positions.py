"""Positions of robots that come after a trial: files of those who walked with them, kept beside its evidence."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core import files
from fieldkit.core.columns import Measured
from fieldkit.core.errors import ConfigurationError, EvidenceError, nearest
from fieldkit.core.model import Role, Status
from fieldkit.core.units import format_bytes, parse_offset_m
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.positions import accounts, recorded, where
from fieldkit.measure.positions.accounts import Account, Accounts
from fieldkit.measure.positions.samples import LOCAL, WGS84
from fieldkit.trial import gates, journal, manifest, store
from fieldkit.trial.plan import Plan
from fieldkit.trial.rebuild import Rebuilt, rebuild

MOST_BYTES: Final = 64 << 20
"""A day at 10 Hz, as GPX."""


@dataclass(frozen=True)
class Spotted:
    """What the columns of one attempt say of positions.

    Attributes:
        attempt: Its folder's name.
        told_by: Who tells where robots were; None where nobody does but, perhaps, the testbed.
        distances_m: Smallest and largest distance by what was measured: `transfer`, `rtt`, `up.rtt`.
        missing: Why there is none, by the same.
    """

    attempt: str
    told_by: str | None
    distances_m: Mapping[str, tuple[float, float]]
    missing: Mapping[str, str]


def give(
    folder: Path, told: Mapping[Role, Path | Account], *, offset_s: float, gap_s: float, heights: bool
) -> Rebuilt:
    """Keep what tells where robots were with a trial, instead of what was given before, and make its tables anew.

    Args:
        folder: The trial's folder.
        told: GPX or CSV, or a place in which the robot stood, by role; nobody to forget what was given.
        offset_s: Added to the times of the files it makes them the laptop's.
        gap_s: Longest time between two points in which a robot went straight.
        heights: Whether heights over the ellipsoid count.

    Raises:
        ConfigurationError: `folder` is no trial, another fieldkit runs it, it has no such role, or a file is missing.
        EvidenceError: A file cannot be read, or the trial's evidence is not as it was kept.
    """
    plan = store.read_plan(folder)
    for role, source in told.items():
        _demand_role(plan, role)
        if isinstance(source, Path):
            _demand_file(source)
            recorded.read_file(source)
    # What was given before is replaced, whatever became of it.
    others = {name: what for name, what in manifest.differences(folder).items() if not manifest.is_positions(name)}
    if others:
        what = f"the evidence is not what was measured: {manifest.few(others)}"
        raise EvidenceError(what, where=str(folder), remedy="restore it from a copy")
    with journal.claimed(folder):
        kept = {role: _kept(folder, role, source, offset_s, gap_s) for role, source in told.items()}
        if kept:
            text = accounts.text(Accounts(kept, heights=heights))
            files.write(folder / accounts.FILE, text.encode())
        else:
            (folder / accounts.FILE).unlink(missing_ok=True)
        _remove_others(folder, {account.file for account in kept.values()})
        if (folder / store.MANIFEST_FILE).exists():
            manifest.Manifest(folder).renew_positions()
    return rebuild(folder)


def _demand_role(plan: Plan, role: Role) -> None:
    if role not in plan.cast:
        remedy = nearest(role, plan.cast, f"roles of the trial: {', '.join(plan.cast)}")
        raise ConfigurationError(f"the trial has no role {role}", remedy=remedy)


def _demand_file(path: Path) -> None:
    if not path.is_file():
        raise ConfigurationError(
            "there is no such file", where=str(path), remedy="name GPX, CSV, or a place: 48.1,11.5"
        )
    if (size_bytes := path.stat().st_size) > MOST_BYTES:
        what = f"has {format_bytes(size_bytes)}, and {format_bytes(MOST_BYTES)} are read"
        raise ConfigurationError(what, where=str(path), remedy="cut it to the time of the trial")


def _kept(folder: Path, role: Role, source: Path | Account, offset_s: float, gap_s: float) -> Account:
    """Return the account of a robot, its file kept in the trial's folder."""
    if isinstance(source, Account):
        return source
    name = f"{store.POSITIONS}{role}{source.suffix.lower()}"
    with source.open("rb") as content, files.replacing(folder / name) as kept:
        shutil.copyfileobj(content, kept)
    return Account(file=name, offset_s=offset_s, gap_s=gap_s)


def _remove_others(folder: Path, names: set[str]) -> None:
    for path in folder.glob(f"{store.POSITIONS}*"):
        if path.name not in names:
            path.unlink()


def told(text: str) -> tuple[Role, Path | Account]:
    """Return a role and what tells where its robot was: `receiver=walk.gpx`, `sender=48.1,11.5`, `sender=0m,5m`.

    A third number is the height in metres over the ellipsoid.

    Raises:
        ConfigurationError: It is no such pair.
    """
    name, separator, source = text.partition("=")
    try:
        role = Role(name)
    except ValueError:
        separator = ""
    if not separator or not source:
        raise ConfigurationError(f"{text[:80]!r} is no ROLE=FILE", remedy="write for example receiver=walk.gpx")
    return role, _place(source) or Path(source)


def _place(text: str) -> Account | None:
    """Return a place in which a robot stood; None if the text is none."""
    try:
        (one, one_is_length), (two, is_length), *third = map(_degrees_or_m, text.split(","))
    except ValueError:
        return None
    fits = is_length or (abs(one) <= 90 and abs(two) <= 180)
    if one_is_length is not is_length or not fits or len(third) > 1:
        return None
    height_m = third[0][0] if third else 0.0 if is_length else None
    return Account(place=(one, two, height_m), frame=LOCAL if is_length else WGS84)


def _degrees_or_m(text: str) -> tuple[float, bool]:
    """Return a number, and whether it is a length; raises `ValueError` where it is neither."""
    with suppress(ValueError):
        return float(text), False
    try:
        return parse_offset_m(text.strip()), True
    except ConfigurationError as error:
        raise ValueError from error


def spotted(folder: Path) -> Iterator[Spotted]:
    """Yield what each valid attempt of a trial says of positions, measured again.

    Raises:
        ConfigurationError: `folder` is no trial.
        EvidenceError: The journal is damaged.
    """
    plan = store.read_plan(folder)
    for attempt in journal.ended(journal.history(folder, plan)):
        if attempt.status is Status.VALID:
            evidence = AttemptEvidence(store.attempt_folder(folder, attempt.folder))
            measured = gates.judge(plan, attempt.repeat, evidence).measured
            yield Spotted(attempt.folder, where.in_words(evidence), dict(_distances_m(measured)), _missing(measured))


_SMALLEST: Final = "_distance_min_m"


def _distances_m(measured: Measured) -> Iterator[tuple[str, tuple[float, float]]]:
    for name, least in measured.values.items():
        if name.endswith(_SMALLEST):
            what = name.removesuffix(_SMALLEST)
            yield what, (float(least), float(measured.values[f"{what}_distance_max_m"]))


def _missing(measured: Measured) -> Mapping[str, str]:
    return {name.removesuffix(_SMALLEST): why for name, why in measured.missing.items() if name.endswith(_SMALLEST)}
