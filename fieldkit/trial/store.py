"""A trial's folder: file names, plan, and folders of attempts.

The folder of an attempt is synced to disk before it is renamed to its final name.
"""

import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files, laptop_files
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.model import RepeatId
from fieldkit.trial.plan import PLAN_FILE, Plan

MANIFEST_FILE: Final = laptop_files.MANIFEST
TRIAL_CSV: Final = laptop_files.TRIAL_CSV
SUMMARY_CSV: Final = laptop_files.SUMMARY_CSV
PREFLIGHT_FILE: Final = laptop_files.PREFLIGHT
REPEATS: Final = "repeats"
POSITIONS: Final = "positions-"
"""Prefix of the files with positions of robots that were added after the trial."""


def prepare(out: Path) -> None:
    """Create the folder for trials if it does not exist, and check that files can be created in it.

    This is done before robots are used.

    Raises:
        ConfigurationError: The folder cannot be created, or no file can be created in it.
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
        ConfigurationError: `out` cannot be written, or the trial already exists.
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


def attempt_folder(folder: Path, name: str) -> Path:
    """Return the evidence folder of an attempt. `folder` is the trial's folder, `name` is `Attempt.folder`."""
    return folder / REPEATS / name


def open_attempt(folder: Path, repeat: RepeatId) -> Path:
    """Create and return an empty folder for an attempt's evidence.

    Files of an interrupted attempt of the same repeat are removed.
    """
    partial_folder = _partial_folder(folder, repeat)
    shutil.rmtree(partial_folder, ignore_errors=True)
    partial_folder.mkdir()
    return partial_folder


def reopen_attempt(folder: Path, repeat: RepeatId) -> Path:
    """Return the folder of an attempt whose evidence is fetched again.

    Partially fetched files are kept in it; completely fetched files and subfolders are removed.
    """
    partial_folder = _partial_folder(folder, repeat)
    partial_folder.mkdir(exist_ok=True)
    for path in partial_folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif not is_partial(path):
            path.unlink()
    return partial_folder


def _partial_folder(folder: Path, repeat: RepeatId) -> Path:
    return attempt_folder(folder, f".{repeat}.partial")


def is_partial(path: Path) -> bool:
    """Return True if a file in an attempt's folder was only partially fetched."""
    return path.name.startswith(".")


def commit_attempt(partial_folder: Path, name: str) -> Path:
    """Sync an attempt's files to disk and rename its folder to `name`. Partially fetched files are removed."""
    for path in filter(is_partial, list(partial_folder.iterdir())):
        path.unlink()
    files.sync((partial_folder, *partial_folder.rglob("*")))
    final_folder = partial_folder.with_name(name)
    partial_folder.rename(final_folder)
    files.sync_folder(final_folder.parent)
    return final_folder


def find_committed_attempt(folder: Path, names: Iterable[str]) -> Path | None:
    """Return the final folder of an attempt, or None if there is none.

    The folder exists if fieldkit was killed after it had renamed the folder, and before it wrote the end of the
    attempt to the journal.

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
            f"{free_bytes >> 20} MiB are free on this machine, but an attempt needs {needed_bytes >> 20} MiB",
            where=str(folder),
            remedy=f"free some space, then: {shell_command('fieldkit', 'resume', folder)}",
        )
