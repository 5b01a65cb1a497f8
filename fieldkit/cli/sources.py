"""Find trials and CSV files at the PATHs of aggregate, report, compare and export, and read their repeats."""

import os
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from fieldkit.analysis import repeats
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.cli.display import show_note
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, EvidenceError, nearest, typed
from fieldkit.trial import rows, store
from fieldkit.trial.columns import trial_columns
from fieldkit.trial.plan import PLAN_FILE


def load(
    paths: Sequence[Path], *, rebuild: bool = False, columns: Collection[str] | None = None, undeclared: bool = False
) -> Repeats:
    """Return the attempts in the trials and CSV files at or below `paths`, each once, as `repeats.read`.

    Args:
        paths: Folders of trials, CSV files with the columns of trial.csv, or folders with trials below.
        rebuild: Whether to measure raw evidence again; nothing is written.
        columns: Columns that are needed, None for all.
        undeclared: Whether to keep columns that no kind of step which is installed declares; a note names them.

    Raises:
        ConfigurationError: A path does not exist or has no trial below, a file is none of ours, two sources
            contradict each other, or there is no evidence to rebuild from.
        EvidenceError: A line or a journal is damaged, no trial has its table, or no repeat has ended.
    """
    tables = list({_identity(table): table for path in paths for table in _tables(path, rebuild=rebuild)}.values())
    where = " ".join(map(str, paths))
    if not tables:
        remedy = "add --rebuild, or make each as the notes above say"
        raise EvidenceError(f"no trial there has its {store.TRIAL_CSV}", where=where, remedy=remedy)
    others = repeats.undeclared_in(tables, trial_columns()) if undeclared and not rebuild else ()
    if others:
        names = ", ".join(one.name for one in others)
        show_note(f"kept as text, because no kind of step that is installed declares it: {names}")
    found, notes = repeats.deduplicated(
        repeats.read(tables, (*trial_columns(), *others), columns, _measured if rebuild else Path.read_bytes)
    )
    for note in notes:
        show_note(note)
    if not len(found):
        begun = next((table.parent for table in tables if (table.parent / PLAN_FILE).is_file()), None)
        raise EvidenceError(
            "no repeat has ended yet",
            where=where,
            remedy=typed("fieldkit", "resume", begun) if begun else "name a trial that ran",
        )
    return found


def condition(text: str) -> tuple[str, ...]:
    """Return the columns that `--by` names, each once.

    Raises:
        ConfigurationError: There is no such column.
    """
    names = tuple(name.strip() for name in text.split(","))
    known = [*DEFAULT_BY, *(column.name for column in trial_columns()), SOURCE]
    for name in names:
        if name not in known:
            raise ConfigurationError(
                f"--by: there is no column {name!r}",
                remedy=nearest(name, known, "fieldkit columns lists them"),
            )
    return tuple(dict.fromkeys(names))


def _tables(path: Path, *, rebuild: bool) -> Iterator[Path]:
    """Yield the CSV file of each trial at or below a path."""
    if path.is_file():
        yield path
        return
    if not path.is_dir():
        raise ConfigurationError("there is no such file or folder", where=str(path), remedy=typed("ls", path.parent))
    folders = list(_trials(path, set()))
    if not folders:
        raise ConfigurationError(
            "no trial is there or below",
            where=str(path),
            remedy=f"name the folder that trials are in, or CSV files: {typed(path)}/*.csv",
        )
    for folder in folders:
        if not rebuild and (what := files.foreign(folder / store.TRIAL_CSV)):
            show_note(f"{folder / store.TRIAL_CSV}: {what}, and is left out")
        elif rebuild or (folder / store.TRIAL_CSV).is_file():
            yield folder / store.TRIAL_CSV
        else:
            how = typed("fieldkit", "rebuild", folder)
            show_note(f"{folder}: has no {store.TRIAL_CSV} and is left out; to make it: {how}")


def _trials(folder: Path, seen: set[tuple[int, int]]) -> Iterator[Path]:
    """Yield the folders of trials at or below one, sorted; links are followed, in a circle once."""
    status = folder.stat()
    if (status.st_dev, status.st_ino) in seen:
        return
    seen.add((status.st_dev, status.st_ino))
    with os.scandir(folder) as scan:
        entries = sorted(scan, key=lambda entry: entry.name)
    if any(entry.name in {PLAN_FILE, store.TRIAL_CSV} for entry in entries):
        yield folder
        return
    for entry in entries:
        if not entry.name.startswith(".") and not entry.name.endswith(".partial") and entry.is_dir():
            yield from _trials(folder / entry.name, seen)


def _identity(table: Path) -> object:
    """Return what two paths to one table have in common."""
    status = table.parent.stat() if table.name == store.TRIAL_CSV else table.stat()
    return status.st_dev, status.st_ino


def _measured(table: Path) -> bytes:
    """Return a trial's table as its raw evidence gives it."""
    from fieldkit.trial import rebuild  # noqa: PLC0415 (gates and all, which no table needs that is there)

    folder = table.parent
    if table.name != store.TRIAL_CSV or not (folder / PLAN_FILE).is_file():
        raise ConfigurationError(
            "a table alone has no raw evidence to rebuild from",
            where=str(table),
            remedy="name the folder of the trial, or leave out --rebuild",
        )
    plan = store.read_plan(folder)
    note_differences(folder)
    return rows.to_csv(rebuild.measured(folder, plan)).encode()


def note_differences(folder: Path) -> None:
    """Show a note on evidence that is measured again and is not what was measured first."""
    from fieldkit.trial import manifest  # noqa: PLC0415 (as above)

    if found := manifest.differences(folder):
        show_note(f"{folder}: measured as it is now, which is not as it was kept: {manifest.few(found)}")
