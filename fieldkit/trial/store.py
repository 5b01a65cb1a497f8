"""A trial's folder: file names, plan, and folders of attempts, which are synced before they are renamed."""

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files, laptop_files
from fieldkit.core.errors import ConfigurationError, EvidenceError, shell_command
from fieldkit.core.model import RepeatId
from fieldkit.trial import step_packages
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE, Plan

MANIFEST_FILE: Final = laptop_files.MANIFEST
TRIAL_CSV: Final = laptop_files.TRIAL_CSV
SUMMARY_CSV: Final = laptop_files.SUMMARY_CSV
PREFLIGHT_FILE: Final = laptop_files.PREFLIGHT
REPEATS: Final = "repeats"
POSITIONS: Final = "positions-"
"""Prefix of the files with positions of robots that were added after the trial."""

DEPTH: Final = 3
"""Maximum depth of evidence below `repeats/`: in a subfolder of an attempt's folder."""

_TRIAL_FILES: Final = frozenset(
    {
        PLAN_FILE,
        JOURNAL_FILE,
        laptop_files.MOTION,
        PREFLIGHT_FILE,
        TRIAL_CSV,
        SUMMARY_CSV,
        MANIFEST_FILE,
        REPEATS,
        laptop_files.POSITIONS,
    }
)
"""Files that fieldkit reads and writes in a trial's folder; other files in it are ignored."""


def prepare(out: Path) -> None:
    """Create the folder for trials; called before any robot is used.

    Raises:
        ConfigurationError: The folder cannot be created or written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise ConfigurationError(
            f"no trial can be stored there: {error.strerror}", where=str(out), remedy="choose another --out"
        ) from error


def create(out: Path, plan: Plan) -> Path:
    """Create the folder of a new trial and write its plan.

    Raises:
        ConfigurationError: `out` cannot be written, or the trial exists.
    """
    folder = out / plan.trial
    content = schema.dump(plan).encode()
    try:
        (folder / REPEATS).mkdir(parents=True)
        files.write(folder / PLAN_FILE, content)
        files.sync_folder(out)
    except OSError as error:
        raise ConfigurationError(
            f"cannot create the trial's folder: {error.strerror}", where=str(folder), remedy="choose another --out"
        ) from error
    return folder


def read_plan(folder: Path) -> Plan:
    """Return the plan of a trial.

    Raises:
        ConfigurationError: The folder has no plan, or the plan was edited.
        EvidenceError: As for `require_plain`.
    """
    require_plain(folder)
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


def require_plain(folder: Path) -> None:
    """Raise an error if a file of the trial is not a plain file or folder.

    A trial may come from another person. Links could lead out of its folder, and reading a pipe could block.

    Raises:
        EvidenceError: A file that fieldkit reads or writes there is a link, a pipe or a device.
    """
    for path, problem in unexpected_files(folder):
        name = path.relative_to(folder).parts[0]
        if name in _TRIAL_FILES or name.startswith(POSITIONS):
            raise EvidenceError(
                problem,
                where=str(path),
                remedy="get a copy with plain files from the person who ran the trial; no others are read",
            )


def unexpected_files(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield each path in a trial's folder that is neither a plain file nor one of its folders, and its type."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if file_type := files.unexpected_type(path):
            yield path, file_type
        elif path.name == REPEATS and path.is_dir():
            yield from _unexpected_below(path, DEPTH)


def _unexpected_below(folder: Path, depth: int) -> Iterator[tuple[Path, str]]:
    with os.scandir(folder) as scan:
        entries = sorted(scan, key=lambda entry: entry.name)
    for entry in entries:
        path = folder / entry.name
        if entry.is_dir(follow_symlinks=False):
            if depth == 1:
                yield path, "it is a folder, deeper than evidence can be"
            else:
                yield from _unexpected_below(path, depth - 1)
        elif not entry.is_file(follow_symlinks=False):
            yield path, files.unexpected_type(path)


def attempt_folder(folder: Path, name: str) -> Path:
    """Return the evidence folder of an attempt; `folder` is the trial's folder, `name` is `Attempt.folder`."""
    return folder / REPEATS / name


def open_attempt(folder: Path, repeat: RepeatId) -> Path:
    """Return an empty folder for an attempt's evidence; remains of an interrupted attempt are removed."""
    partial = _partial(folder, repeat)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    return partial


def reopen_attempt(folder: Path, repeat: RepeatId) -> Path:
    """Return the folder of an attempt whose evidence is fetched again; partially fetched files are kept in it."""
    partial = _partial(folder, repeat)
    partial.mkdir(exist_ok=True)
    for path in partial.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif not is_partial(path):
            path.unlink()
    return partial


def _partial(folder: Path, repeat: RepeatId) -> Path:
    return attempt_folder(folder, f".{repeat}.partial")


def is_partial(path: Path) -> bool:
    """Return True if a file of an attempt's folder was not fetched completely."""
    return path.name.startswith(".")


def commit_attempt(partial: Path, name: str) -> Path:
    """Sync an attempt's files to disk and give its folder the final name; partially fetched files are removed."""
    for path in filter(is_partial, list(partial.iterdir())):
        path.unlink()
    files.sync((partial, *partial.rglob("*")))
    final = partial.with_name(name)
    partial.rename(final)
    files.sync_folder(final.parent)
    return final


def unjournalled_attempt(folder: Path, names: Iterable[str]) -> Path | None:
    """Return the committed folder of an attempt whose journal entry is missing after a kill, or None.

    Args:
        folder: The trial's folder.
        names: The possible names of the attempt's folder.
    """
    return next((path for name in names if (path := attempt_folder(folder, name)).is_dir()), None)


def require_space(folder: Path, needed_bytes: int) -> None:
    """Raise an error if this machine has too little space for the evidence of an attempt.

    Raises:
        ConfigurationError: Less than `needed_bytes` is free.
    """
    free_bytes = files.free_bytes(folder)
    if free_bytes < needed_bytes:
        raise ConfigurationError(
            f"{free_bytes >> 20} MiB are free on this machine, an attempt needs {needed_bytes >> 20} MiB",
            where=str(folder),
            remedy=f"free some space, then: {shell_command('fieldkit', 'resume', folder)}",
        )
