"""A trial's folder: written under temporary names, fsynced, renamed; a manifest of sums over all of it."""

import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.model import RepeatId
from fieldkit.trial.plan import PLAN_FILE, Plan

MANIFEST_FILE: Final = "MANIFEST.sha256"
TRIAL_CSV: Final = "trial.csv"
SUMMARY_CSV: Final = "summary.csv"
PREFLIGHT_FILE: Final = "preflight.txt"
REPEATS: Final = "repeats"


def prepare(out: Path) -> None:
    """Make the folder that trials go into, before anything is started for them.

    Raises:
        ConfigurationError: It cannot be made or written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".probe"
        probe.touch()
        probe.unlink()
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
    except OSError as error:
        raise ConfigurationError(
            f"cannot make the trial's folder: {error.strerror}", where=str(folder), remedy="choose another --out"
        ) from error
    return folder


def read_plan(folder: Path) -> Plan:
    """Return the plan of a trial.

    Raises:
        ConfigurationError: The folder holds none, or it was edited.
    """
    if not (folder / PLAN_FILE).is_file():
        raise ConfigurationError(
            f"there is no {PLAN_FILE}", where=str(folder), remedy="name the folder of a trial, trials/<stamp>_..."
        )
    return schema.load(folder / PLAN_FILE, Plan)


def attempt_folder(folder: Path, name: str) -> Path:
    """Return the folder of an attempt's evidence, given that of its trial and its own name, `Attempt.folder`."""
    return folder / REPEATS / name


def open_attempt(folder: Path, repeat: RepeatId) -> Path:
    """Return an empty folder for an attempt's evidence; what an interrupted attempt left there is removed."""
    partial = attempt_folder(folder, f".{repeat}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    return partial


def keep_attempt(partial: Path, name: str) -> Path:
    """Bring an attempt's files to disk and give its folder the final name."""
    for path in partial.rglob("*"):
        if path.is_dir():
            files.sync_folder(path)
            continue
        with path.open("rb") as file:
            os.fsync(file.fileno())
    files.sync_folder(partial)
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
            remedy=f"free some space, then: fieldkit resume {folder}",
        )


class Manifest:
    """Sums over a trial's files, in the format of `sha256sum`, kept up while the trial grows.

    Args:
        folder: The trial's folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._evidence: dict[str, str] = {}

    def add(self, attempt: Path) -> None:
        """Take in the evidence of an attempt that was kept; nothing writes it twice, so it is read once."""
        files = (path for path in attempt.rglob("*") if path.is_file())
        self._evidence |= {path.relative_to(self._folder).as_posix(): _sha256(path) for path in files}

    def write(self) -> None:
        """Write the manifest: the evidence taken in, and the trial's own files as they stand now."""
        own = {path.name: _sha256(path) for path in self._folder.iterdir() if _is_listed(path)}
        lines = "".join(f"{digest}  {name}\n" for name, digest in sorted((own | self._evidence).items()))
        files.write(self._folder / MANIFEST_FILE, lines.encode())


def verify(folder: Path) -> list[str]:
    """Compare a trial's files with its manifest.

    Returns:
        One sentence per difference, sorted by file; empty when all agree.

    Raises:
        EvidenceError: There is no manifest, or it cannot be read.
    """
    path = folder / MANIFEST_FILE
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        listed = {name: digest for digest, name in (line.split("  ", 1) for line in lines)}
    except (OSError, ValueError) as error:
        raise EvidenceError(
            "no readable manifest", where=str(path), remedy="name the folder of a trial that ran at least one repeat"
        ) from error
    present = _files(folder)
    problems = dict.fromkeys(listed.keys() - present.keys(), "missing")
    problems |= dict.fromkeys(present.keys() - listed.keys(), "not in the manifest")
    problems |= {name: "changed" for name in listed.keys() & present.keys() if _sha256(present[name]) != listed[name]}
    return [f"{name}: {problem}" for name, problem in sorted(problems.items())]


def _files(folder: Path) -> dict[str, Path]:
    named = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if _is_listed(path)}
    return {name: path for name, path in named.items() if "/." not in f"/{name}"}


def _is_listed(path: Path) -> bool:
    return path.is_file() and path.name != MANIFEST_FILE and not path.name.startswith(".")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
