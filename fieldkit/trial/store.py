"""A trial's folder: its names, its plan, and the folders of its attempts, brought to disk before they are kept."""

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files, laptop_files
from fieldkit.core.errors import ConfigurationError, EvidenceError, typed
from fieldkit.core.model import RepeatId
from fieldkit.measure.positions import accounts
from fieldkit.trial import step_packages
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE, Plan

MANIFEST_FILE: Final = laptop_files.MANIFEST
TRIAL_CSV: Final = laptop_files.TRIAL_CSV
SUMMARY_CSV: Final = laptop_files.SUMMARY_CSV
PREFLIGHT_FILE: Final = laptop_files.PREFLIGHT
REPEATS: Final = "repeats"
POSITIONS: Final = "positions-"
"""What the names of files begin with that tell where robots were, given after the trial."""

DEPTH: Final = 3
"""How deep evidence lies below `repeats/` at most: in a folder of an attempt's folder."""

_OWN: Final = frozenset(
    {
        PLAN_FILE,
        JOURNAL_FILE,
        laptop_files.MOTION,
        PREFLIGHT_FILE,
        TRIAL_CSV,
        SUMMARY_CSV,
        MANIFEST_FILE,
        REPEATS,
        accounts.FILE,
    }
)
"""What fieldkit reads and writes in a trial's folder; what else lies there is its owner's business."""


def prepare(out: Path) -> None:
    """Make the folder that trials go into, before anything is started for them.

    Raises:
        ConfigurationError: It cannot be made or written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise ConfigurationError(
            f"no trial can be kept there: {error.strerror}", where=str(out), remedy="choose another --out"
        ) from error


def create(out: Path, plan: Plan) -> Path:
    """Make the folder of a new trial with its plan in it.

    Raises:
        ConfigurationError: `out` cannot be written, or the trial exists.
    """
    folder = out / plan.trial
    try:
        (folder / REPEATS).mkdir(parents=True)
        files.write(folder / PLAN_FILE, schema.dump(plan).encode())
        files.sync_folder(out)
    except OSError as error:
        raise ConfigurationError(
            f"cannot make the trial's folder: {error.strerror}", where=str(folder), remedy="choose another --out"
        ) from error
    return folder


def read_plan(folder: Path) -> Plan:
    """Return the plan of a trial, in whose folder there are files and folders alone.

    Raises:
        ConfigurationError: The folder holds none, or it was edited.
        EvidenceError: As `demand_plain`.
    """
    demand_plain(folder)
    if not (folder / PLAN_FILE).is_file():
        raise ConfigurationError(
            f"there is no {PLAN_FILE}", where=str(folder), remedy="name the folder of a trial, trials/<stamp>_..."
        )
    document = schema.read(folder / PLAN_FILE)
    if absent := step_packages.missing(document.data):
        raise ConfigurationError(
            absent,
            where=str(folder / PLAN_FILE),
            remedy="install that package with pip: rebuild needs any version of it, resume the same one",
        )
    return schema.validate(document, Plan)


def demand_plain(folder: Path) -> None:
    """Refuse a trial from somebody else whose folder leads out of itself, or would keep who reads it waiting.

    Raises:
        EvidenceError: What fieldkit reads and writes there is no plain file or folder: a link, a pipe, a device.
    """
    for path, what in foreign(folder):
        name = path.relative_to(folder).parts[0]
        if name in _OWN or name.startswith(POSITIONS):
            raise EvidenceError(
                what,
                where=str(path),
                remedy="ask whoever made the trial for it; fieldkit reads plain files of the trial alone",
            )


def foreign(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield what lies in a trial's folder and is neither a plain file nor a folder of it, and what it is instead."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if what := files.foreign(path):
            yield path, what
        elif path.name == REPEATS and path.is_dir():
            yield from _foreign_below(path, DEPTH)


def _foreign_below(folder: Path, depth: int) -> Iterator[tuple[Path, str]]:
    with os.scandir(folder) as scan:
        entries = sorted(scan, key=lambda entry: entry.name)
    for entry in entries:
        path = folder / entry.name
        if entry.is_dir(follow_symlinks=False):
            if depth == 1:
                yield path, "it is a folder, where evidence has none any more"
            else:
                yield from _foreign_below(path, depth - 1)
        elif not entry.is_file(follow_symlinks=False):
            yield path, files.foreign(path)


def attempt_folder(folder: Path, name: str) -> Path:
    """Return the folder of an attempt's evidence, given that of its trial and its own name, `Attempt.folder`."""
    return folder / REPEATS / name


def open_attempt(folder: Path, repeat: RepeatId) -> Path:
    """Return an empty folder for an attempt's evidence; what an interrupted attempt left there is removed."""
    partial = _partial(folder, repeat)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    return partial


def reopen_attempt(folder: Path, repeat: RepeatId) -> Path:
    """Return the folder of an attempt whose evidence is to be fetched again, with what was half fetched in it."""
    partial = _partial(folder, repeat)
    partial.mkdir(exist_ok=True)
    for path in partial.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif not is_half(path):
            path.unlink()
    return partial


def _partial(folder: Path, repeat: RepeatId) -> Path:
    return attempt_folder(folder, f".{repeat}.partial")


def is_half(path: Path) -> bool:
    """Return whether a file of an attempt's folder was being fetched when something cut that."""
    return path.name.startswith(".")


def keep_attempt(partial: Path, name: str) -> Path:
    """Bring an attempt's files to disk and give its folder the final name; what was half fetched is removed."""
    for path in filter(is_half, list(partial.iterdir())):
        path.unlink()
    files.sync((partial, *partial.rglob("*")))
    final = partial.with_name(name)
    partial.rename(final)
    files.sync_folder(final.parent)
    return final


def kept_unentered(folder: Path, names: Iterable[str]) -> Path | None:
    """Return the folder of an attempt that a kill kept from its entry in the journal, None where there is none.

    Args:
        folder: The trial's folder.
        names: What the attempt's folder may be called.
    """
    return next((path for name in names if (path := attempt_folder(folder, name)).is_dir()), None)


def demand_room(folder: Path, needed_bytes: int) -> None:
    """Stop before an attempt whose evidence this machine could not hold.

    Raises:
        ConfigurationError: Less than `needed_bytes` is free.
    """
    free_bytes = files.free_bytes(folder)
    if free_bytes < needed_bytes:
        raise ConfigurationError(
            f"{free_bytes >> 20} MiB are free on this machine, an attempt needs {needed_bytes >> 20} MiB",
            where=str(folder),
            remedy=f"free some space, then: {typed('fieldkit', 'resume', folder)}",
        )
