"""Stores the state of a sweep on disk: a file per finished run, a file per failed run, and a file with the plan.

A file is written under a temporary name, synced and renamed, so that it is complete or does not exist.
"""

import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from fieldkit.core import files
from fieldkit.core.columns import Value
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.laptop_files import SWEEP, SWEEP_RESULTS
from sim_backends.cosim.sweeps.sweep_plan import SweepPlan, SweepRun

Rows = Sequence[Mapping[str, Value]]

_RUNS: Final = "runs"
_FAILED: Final = "failed"
_LOCK: Final = ".lock"


@dataclass(frozen=True)
class RunFailure:
    """The last failure of a run.

    Attributes:
        attempts: Number of attempts so far.
        reason: Reason of the last failure.
        remedy: Remedy for the failure; may be empty.
        exit_code: Exit code of the error.
        rows: A row of columns for each of its flows, with the results until the failure.
        is_final: True if another attempt would fail in the same way.
    """

    attempts: int
    reason: str
    remedy: str
    exit_code: int
    rows: Rows = field(default_factory=tuple)
    is_final: bool = False


class SweepFolder:
    """The folder of a sweep.

    Args:
        path: The folder.
        continue_command: The command that continues the sweep, for messages.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path, continue_command: str) -> None:
        self.path = path
        self._continue_command = continue_command

    @property
    def results(self) -> Path:
        """The folder of the dataset."""
        return self.path / SWEEP_RESULTS

    @contextmanager
    def opened(self, plan: SweepPlan) -> Iterator[None]:
        """Create the folder or open it again, and lock it during the body of the `with` statement.

        Raises:
            ConfigurationError: The folder contains other files or another sweep, another process runs the sweep, or
                the folder cannot be written.
            EvidenceError: The file with the plan is damaged.
        """
        with self.error_conversion():
            self.path.mkdir(parents=True, exist_ok=True)
            self._require_same_sweep(plan)
            for folder in (_RUNS, _FAILED):
                (self.path / folder).mkdir(exist_ok=True)
            descriptor = os.open(self.path / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise ConfigurationError(
                    "another process runs this sweep", where=str(self.path), remedy="wait for it, or stop it first"
                ) from None
            self._write(self.path / SWEEP, _description(plan))
            yield
        finally:
            os.close(descriptor)

    def _require_same_sweep(self, plan: SweepPlan) -> None:
        """Check that the folder is empty, or contains a sweep of the same scenario with the same names of factors."""
        path = self.path / SWEEP
        if not path.exists():
            if next(self.path.iterdir(), None) is not None:
                raise ConfigurationError("this folder is not empty", where=str(self.path), remedy="choose another -o")
            return
        # A folder without its plan is refused, so a damaged plan must not be deleted.
        stored_plan = self._read(path, remedy="restore it from a copy, or choose another -o")
        current_plan = _description(plan)
        for key in ("scenario", "factors"):
            # Of factors, only the names are compared (the keys), because a sweep may be continued with other values.
            old_value, new_value = (
                [*value] if isinstance(value, dict) else value for value in (stored_plan.get(key), current_plan[key])
            )
            if old_value != new_value:
                raise ConfigurationError(
                    f"this is a sweep with other {key}: {old_value}", where=str(self.path), remedy="choose another -o"
                )

    def finished_runs(self) -> set[str]:
        """Return the names of the finished runs."""
        return {path.stem for path in (self.path / _RUNS).glob("*.json")}

    def rows(self, run: SweepRun) -> Rows:
        """Return a row of columns for each flow of a run; empty if the run has neither finished nor failed.

        Raises:
            EvidenceError: The file of the run is damaged.
        """
        path = self.path / _RUNS / f"{run.name}.json"
        if path.exists():
            rows: Rows = self._read(path)["rows"]
            return rows
        failure = self.failure(run)
        return () if failure is None else failure.rows

    def write_result(self, run: SweepRun, result: Mapping[str, Any]) -> None:
        """Write the result of a run.

        Raises:
            ConfigurationError: The result cannot be written.
        """
        self._write(self.path / _RUNS / f"{run.name}.json", _identity(run) | dict(result))
        (self.path / _FAILED / f"{run.name}.json").unlink(missing_ok=True)

    def failure(self, run: SweepRun) -> RunFailure | None:
        """Return the last failure of a run; None if it did not fail, or has finished since.

        Raises:
            EvidenceError: The file of the failure is damaged.
        """
        path = self.path / _FAILED / f"{run.name}.json"
        if not path.exists():
            return None
        content = self._read(path)
        return RunFailure(**{name: content[name] for name in RunFailure.__dataclass_fields__ if name in content})

    def write_failure(self, run: SweepRun, failure: RunFailure) -> None:
        """Write the failure of a run. Raises the errors of `write_result`."""
        self._write(self.path / _FAILED / f"{run.name}.json", _identity(run) | vars(failure))

    @contextmanager
    def error_conversion(self) -> Iterator[None]:
        """Convert an `OSError` of the body to a `ConfigurationError`, whose remedy continues the sweep."""
        try:
            yield
        except OSError as error:
            remedy = "free some space" if files.is_disk_full(error) else "remove the cause, or choose another -o"
            raise ConfigurationError(
                f"cannot be written: {error.strerror}",
                where=str(error.filename or self.path),
                remedy=f"all finished runs are saved; {remedy}, then continue: {self._continue_command}",
            ) from error

    def _write(self, path: Path, content: Mapping[str, Any]) -> None:
        with self.error_conversion():
            files.write(path, json.dumps(content, indent=1).encode() + b"\n")

    def _read(self, path: Path, remedy: str = "delete it, and run again") -> dict[str, Any]:
        try:
            content = json.loads(path.read_bytes())
        except (OSError, ValueError) as error:
            raise EvidenceError(f"cannot be read: {error}", where=str(path), remedy=remedy) from error
        return dict(content)


def _identity(run: SweepRun) -> dict[str, Any]:
    return {"fieldkit": version("fieldkit"), "settings": dict(run.setting.values), "seed": run.seed}


def _description(plan: SweepPlan) -> dict[str, Any]:
    """Return the content of the file with the plan."""
    return {
        "fieldkit": version("fieldkit"),
        "scenario": plan.scenario.name,
        "factors": {factor.name: list(factor.values) for factor in plan.factors},
        "seeds": list(plan.seeds),
    }
