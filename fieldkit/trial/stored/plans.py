"""The plan of a stored trial, and the types of the files in its folder."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files, laptop_files
from fieldkit.core.columns import Column
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.steps import base
from fieldkit.trial import frozen, store
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE, Plan

DEPTH: Final = 3
"""Maximum depth of an evidence file below `repeats/`: `ATTEMPT/SUBFOLDER/FILE`."""

_TRIAL_FILES: Final = frozenset(
    {
        PLAN_FILE,
        JOURNAL_FILE,
        laptop_files.MOTION,
        store.PREFLIGHT_FILE,
        store.TRIAL_CSV,
        store.SUMMARY_CSV,
        store.MANIFEST_FILE,
        store.REPEATS,
        laptop_files.POSITIONS,
    }
)
"""Names of the files and folders that fieldkit reads and writes in a trial's folder.

Files whose names start with `store.POSITIONS` are read as well; all others are ignored.
"""


def read_plan(folder: Path) -> Plan:
    """Return the plan of a trial.

    Raises:
        ConfigurationError: The folder has no plan, the plan is invalid (for example because it was edited), or a kind
            of its steps is not installed.
        EvidenceError: For the same reasons as `require_plain`.
    """
    require_plain(folder)
    if not (folder / PLAN_FILE).is_file():
        raise ConfigurationError(
            f"there is no {PLAN_FILE}", where=str(folder), remedy="name the folder of a trial: trials/<time>_..."
        )
    document = schema.read(folder / PLAN_FILE)
    if missing_kinds := _missing_kinds(document.data):
        raise ConfigurationError(
            missing_kinds,
            where=str(folder / PLAN_FILE),
            remedy="install that package with pip: any version for rebuild, the same version for resume",
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
        if name in _TRIAL_FILES or name.startswith(store.POSITIONS):
            raise EvidenceError(
                problem,
                where=str(path),
                remedy="get a copy with plain files from the person who ran the trial; only plain files are read",
            )


def unexpected_files(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield each path in a trial's folder that is neither a plain file nor a folder, with a text about its type.

    Below `repeats/`, folders deeper than the folders of evidence are yielded as well.
    """
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if file_type := files.unexpected_type(path):
            yield path, file_type
        elif path.name == store.REPEATS and path.is_dir():
            yield from _unexpected_below(path, DEPTH)


def _unexpected_below(folder: Path, depth: int) -> Iterator[tuple[Path, str]]:
    with os.scandir(folder) as scan:
        entries = sorted(scan, key=lambda entry: entry.name)
    for entry in entries:
        path = folder / entry.name
        if entry.is_dir(follow_symlinks=False):
            if depth == 1:
                yield path, "it is a folder at a level below the folders of evidence"
            else:
                yield from _unexpected_below(path, depth - 1)
        elif not entry.is_file(follow_symlinks=False):
            yield path, files.unexpected_type(path)


def _missing_kinds(document: object) -> str | None:
    """Return a sentence with the kinds of step of a plan that are not installed, or None if all are installed.

    Args:
        document: The plan as plain data, before it is validated.
    """
    packages = document.get("step_packages") if isinstance(document, dict) else None
    if not isinstance(packages, dict):
        return None
    missing_kinds = [kind for kind in packages if kind not in base.step_types()]
    if not missing_kinds:
        return None
    sources = (packages[kind] if isinstance(packages[kind], dict) else {} for kind in missing_kinds)
    descriptions = (
        f"step kind `{kind}` from {source.get('package', 'an unknown package')} {source.get('version', '')}".strip()
        for kind, source in zip(missing_kinds, sources, strict=True)
    )
    return f"{', '.join(descriptions)} {'is' if len(missing_kinds) == 1 else 'are'} not installed"


class _PlanColumns(schema.Strict):
    """The part of a plan that lists its columns."""

    columns: frozen.Columns | None = None


def read_columns(path: Path) -> tuple[Column, ...]:
    """Return the columns listed in a `trial.yaml`, if any, without loading the step kinds of its procedure.

    Raises:
        ConfigurationError: The file cannot be read, or an entry is not a valid column.
    """
    document = schema.read(path)
    if not isinstance(document.data, dict) or "columns" not in document.data:
        return ()
    plan = schema.validate(replace(document, data={"columns": document.data["columns"]}), _PlanColumns)
    return tuple(column.column for column in plan.columns or ())


class _ProcedureExpectations(schema.Strict):
    """The part of a procedure that lists its expectations."""

    expect: tuple[str, ...] = ()


def read_expectations(path: Path) -> tuple[str, ...]:
    """Return the expectations of the procedure in a `trial.yaml`, if any, without loading its step kinds.

    Raises:
        ConfigurationError: The file cannot be read, or its expectations are invalid.
    """
    if b"expect:" not in files.read(path):  # most plans have no expectations, and need not be parsed
        return ()
    procedure = schema.read(path).part("procedure")
    data = {"expect": procedure.data["expect"]} if "expect" in procedure.data else {}
    return schema.validate(replace(procedure, data=data), _ProcedureExpectations).expect
