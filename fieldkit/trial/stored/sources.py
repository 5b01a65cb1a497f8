"""Find trials and CSV files at paths for commands and the Python API, and read their repeats."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Final

from fieldkit.analysis import expectations, table_files
from fieldkit.analysis.duplicates import deduplicated
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.quantities import Quantity, quantities, word_columns
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.analysis.row_filters import RowFilter, parse_filter
from fieldkit.core import files, laptop_files
from fieldkit.core.columns import Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError, did_you_mean, shell_command
from fieldkit.core.executors import Workers
from fieldkit.core.units import format_count
from fieldkit.trial import rows, store
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import indexed_tables, plans, tables
from fieldkit.trial.stored.indexed_tables import NO_INDEX, IndexedTables

ALL_PROCESSORS: Final = Workers()

_IN_PARALLEL: Final = 8
"""Smallest number of trials that are measured in parallel by default; starting processes takes a second."""

Note = Callable[[str], None]
"""Shows a sentence about data that is left out or treated in an unexpected way."""


@dataclass(frozen=True)
class Sources:
    """Tables that were found at some paths.

    Attributes:
        where: The paths, for messages.
        tables: The tables, without duplicates.
        columns: The columns of all tables.
        rebuild: Whether raw evidence is measured again instead; nothing is written.
        note: Receives notes.
        workers: Processes that measure raw evidence again.
        row_filter: Chooses rows; None for all.
        indexed: The tables that are in an index.
    """

    where: str
    tables: Sequence[Path]
    columns: Sequence[Column]
    rebuild: bool
    note: Note
    workers: Workers = ALL_PROCESSORS
    row_filter: RowFilter | None = None
    indexed: IndexedTables = NO_INDEX

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """The quantities that can be estimated, by name and in order."""
        return {quantity.name: quantity for quantity in quantities(self.columns)}

    @cached_property
    def words(self) -> Mapping[str, Column]:
        """The columns whose words are counted, by name and in order."""
        return {column.name: column for column in word_columns(self.columns)}

    def condition(self, text: str, *, option: str = "--by") -> tuple[str, ...]:
        """Return the columns that define a condition, without duplicates.

        Args:
            text: Comma-separated names.
            option: The option or argument that gave them; for the message.

        Raises:
            ConfigurationError: There is no such column.
        """
        names = tuple(name.strip() for name in text.split(","))
        names_allowed = [*(column.name for column in self.columns), SOURCE]
        for name in names:
            if name not in names_allowed:
                raise ConfigurationError(
                    f"{option}: there is no column {name!r}",
                    remedy=did_you_mean(name, names_allowed, "fieldkit columns lists them"),
                )
        return tuple(dict.fromkeys(names))

    @cached_property
    def sweep_columns(self) -> Mapping[str, str]:
        """The columns that define a condition, as `datasets.condition`; empty if not all tables are sweeps."""
        if not all(table.is_dir() for table in self.tables):
            return {}
        from fieldkit.analysis import datasets  # noqa: PLC0415 (imports pandas if it is installed)

        return {name: text for table in self.tables for name, text in datasets.condition(table).items()}

    @property
    def sweep_condition(self) -> tuple[str, ...]:
        """The columns that define a condition: the flow and the factors of sweeps; empty if not all are sweeps."""
        return tuple(self.sweep_columns)

    def select(
        self, names: Collection[str], *, option: str = "--quantity"
    ) -> tuple[list[Quantity] | None, list[Column] | None]:
        """Return the quantities and the word columns of some names; both are None, meaning all, if no name is given.

        Raises:
            ConfigurationError: As for `quantity`, with `option` in the message.
        """
        if not names:
            return None, None
        quantities = [self.quantity(name, option=option) for name in names if name not in self.words]
        return quantities, [self.words[name] for name in names if name in self.words]

    def quantity(self, name: str, *, option: str = "--quantity") -> Quantity:
        """Return the quantity of a name; `option` as for `condition`.

        Raises:
            ConfigurationError: There is no such quantity.
        """
        if name not in self.quantities:
            raise ConfigurationError(
                f"{option}: there is no quantity {name!r}",
                remedy=did_you_mean(name, self.quantities, f"it is one of: {', '.join(self.quantities)}"),
            )
        return self.quantities[name]

    def expectations(self) -> Mapping[str, Sequence[Expectation]]:
        """Return the expectations of trials by source folder; a CSV file without its trial has none.

        Raises:
            ConfigurationError: A plan cannot be read.
        """
        by_source: dict[str, list[Expectation]] = {}
        for table in self.tables:
            facts = self.indexed.facts(table)
            for text in tables.expectation_texts(table) if facts is None else facts.expected:
                try:
                    expectation = expectations.parse(text, self.quantities.values())
                except ConfigurationError as error:  # the plan is of an earlier version, or was edited
                    self.note(f"{table.parent}: an expectation is left out: {error.what}")
                else:
                    by_source.setdefault(str(table.parent), []).append(expectation)
        return by_source

    def read(
        self, columns: Collection[str] | None = None, *, also: Collection[str] = (), undeclared: bool = False
    ) -> Repeats:
        """Return the attempts in the tables without duplicates, as `table_files.read`.

        Args:
            columns: Columns that are needed; None for all that are declared.
            also: Columns that are needed even if they are not declared.
            undeclared: Whether to keep all undeclared columns; a note lists them.

        Raises:
            ConfigurationError: A file is not a table of repeats, two tables contradict each other, or there is no
                evidence to rebuild from.
            EvidenceError: A line or a journal is damaged, or no repeat has ended.
        """
        others = [column.name for column in self.columns if table_files.is_undeclared(column)]
        if others and undeclared:
            self.note(f"kept as text, because no installed kind of step declares it: {', '.join(others)}")
        if columns is None:
            columns = {column.name for column in self.columns} - (set() if undeclared else set(others) - set(also))
        if self.row_filter is not None:
            columns = {*columns, *self.row_filter.names}
        content = _remeasured_tables(self.tables, self.workers, self.note) if self.rebuild else Path.read_bytes
        attempts, notes = deduplicated(self._rows(columns, content))
        for note in notes:
            self.note(note)
        if not len(attempts):
            started = next((table.parent for table in self.tables if (table.parent / PLAN_FILE).is_file()), None)
            raise EvidenceError(
                "no repeat has ended yet",
                where=self.where,
                remedy=shell_command("fieldkit", "resume", started) if started else "name a trial that ran",
            )
        return attempts if self.row_filter is None else self._chosen_rows(attempts, self.row_filter)

    def _rows(self, columns: Collection[str], content: Callable[[Path], bytes]) -> Repeats:
        if self.indexed.tables:
            # Of several invalid tables, reading without the index may report another one, so this error is not used.
            with suppress(FieldkitError):
                return table_files.read(self.tables, self.columns, columns, content, self.indexed)
        return table_files.read(self.tables, self.columns, columns, content)

    def _chosen_rows(self, attempts: Repeats, row_filter: RowFilter) -> Repeats:
        chosen = attempts.where(row_filter.mask(attempts))
        if not len(chosen):
            raise EvidenceError(
                f"none of {format_count(len(attempts), 'attempt')} satisfies --where {row_filter.text}",
                where=self.where,
                remedy="a missing value satisfies no comparison; fieldkit columns show NAME explains a column",
            )
        return chosen

    def with_filter(self, text: str) -> "Sources":
        """Return these sources with the rows that satisfy an expression; all rows if it is empty.

        Raises:
            ConfigurationError: As for `parse_filter`.
        """
        columns = {column.name: column for column in self.columns}
        return replace(self, row_filter=parse_filter(text, columns)) if text else self


def find(
    paths: Sequence[Path],
    note: Note,
    *,
    rebuild: bool = False,
    workers: Workers = ALL_PROCESSORS,
    use_index: bool = True,
) -> Sources:
    """Return the tables of the trials and CSV files at or below `paths`, with their columns.

    Args:
        paths: Folders of trials, folders with trials below, or CSV files with the columns of trial.csv.
        note: Receives notes.
        rebuild: Whether to measure raw evidence again.
        workers: Processes that measure it, and that read many plans.
        use_index: Whether to read many tables from an index; the result is the same.

    Raises:
        ConfigurationError: A path does not exist or has no trial below, or as for `tables.declared_columns`.
        EvidenceError: No trial has its table.
    """
    return find_each([paths], note, rebuild=rebuild, workers=workers, use_index=use_index)[0]


def find_each(
    runs: Sequence[Sequence[Path]],
    note: Note,
    *,
    rebuild: bool = False,
    workers: Workers = ALL_PROCESSORS,
    use_index: bool = True,
) -> list[Sources]:
    """Return the sources at the paths of each run, as `find`; all have the columns of all runs."""
    tables_by_run = [_find_tables(paths, note, rebuild=rebuild) for paths in runs]
    all_tables = list(dict.fromkeys(table for run_tables in tables_by_run for table in run_tables))
    indexed = indexed_tables.find(all_tables, workers, note) if use_index and not rebuild else NO_INDEX
    columns = tables.planned_columns(all_tables) if rebuild else tables.declared_columns(all_tables, indexed.facts)
    indexed = indexed_tables.write(indexed, columns, note)
    return [
        Sources(_paths_text(paths), run_tables, columns, rebuild, note, workers, indexed=indexed)
        for paths, run_tables in zip(runs, tables_by_run, strict=True)
    ]


def _find_tables(paths: Sequence[Path], note: Note, *, rebuild: bool) -> list[Path]:
    by_identity = {_identity(table): table for path in paths for table in _tables(path, note, rebuild=rebuild)}
    if not by_identity:
        remedy = "add --rebuild, or run the commands in the notes above"
        raise EvidenceError(f"no trial there has its {store.TRIAL_CSV}", where=_paths_text(paths), remedy=remedy)
    return list(by_identity.values())


def _paths_text(paths: Sequence[Path]) -> str:
    return " ".join(map(str, paths))


def _tables(path: Path, note: Note, *, rebuild: bool) -> Iterator[Path]:
    """Yield the CSV file of each trial at or below a path."""
    if path.is_file():
        yield path
        return
    if not path.is_dir():
        raise ConfigurationError(
            "there is no such file or folder", where=str(path), remedy=shell_command("ls", path.parent)
        )
    folders = trial_folders(path)
    if not folders:
        raise ConfigurationError(
            "there is no trial in this folder or its subfolders",
            where=str(path),
            remedy=f"name the folder that trials are in, or CSV files: {shell_command(path)}/*.csv",
        )
    for folder in folders:
        table = folder / store.TRIAL_CSV
        if (folder / laptop_files.SWEEP).is_file():
            if rebuild:
                raise ConfigurationError(
                    "a sweep has no raw evidence", where=str(folder), remedy="leave out --rebuild"
                )
            if (folder / laptop_files.SWEEP_RESULTS).is_dir():
                yield folder / laptop_files.SWEEP_RESULTS
            else:
                note(f"{folder}: has no results yet; run its command again")
        elif not rebuild and (reason := files.unexpected_type(table)):
            note(f"{table}: {reason}; it is left out")
        elif rebuild or table.is_file():
            yield table
        else:
            command = shell_command("fieldkit", "rebuild", folder)
            note(f"{folder}: has no {store.TRIAL_CSV} and is left out; to make it: {command}")


def trial_folders(path: Path) -> list[Path]:
    """Return the folders of trials at or below a path; empty if there are none, or if it is not a folder."""
    return [Path(folder) for folder in _trials(str(path), set())] if path.is_dir() else []


_MARKS: Final = frozenset({PLAN_FILE, store.TRIAL_CSV, laptop_files.SWEEP})
"""Files in the folder of a trial or a sweep."""


def _trials(folder: str, seen: set[tuple[int, int]]) -> Iterator[str]:
    """Yield the folders of trials and sweeps at or below a folder, sorted.

    Links are followed, each folder is visited once.
    """
    status = os.stat(folder)  # noqa: PTH116 (a path object per folder takes longer than the call)
    if (status.st_dev, status.st_ino) in seen:
        return
    seen.add((status.st_dev, status.st_ino))
    with os.scandir(folder) as scan:
        entries = sorted(scan, key=lambda entry: entry.name)
    if not _MARKS.isdisjoint(entry.name for entry in entries):
        yield folder
        return
    for entry in entries:
        if not entry.name.startswith(".") and not entry.name.endswith(".partial") and entry.is_dir():
            yield from _trials(entry.path, seen)


def _identity(table: Path) -> object:
    """Return the identity of a table, which is the same for two paths to it."""
    is_folder = table.name == store.TRIAL_CSV or table.is_dir()
    status = (table.parent if is_folder else table).stat()
    return status.st_dev, status.st_ino


def _remeasured_tables(tables: Sequence[Path], workers: Workers, note: Note) -> Callable[[Path], bytes]:
    """Return a function that returns the table of a trial, measured again from its raw evidence."""
    if workers.is_default and len(tables) < _IN_PARALLEL:
        return partial(_remeasured_table, note=note)
    from fieldkit.core.tasks import completed  # noqa: PLC0415 (as for rebuild below)

    contents: dict[Path, bytes] = {}
    absolute = [table.absolute() for table in tables]  # workers of a cluster have another working directory
    for end in completed(_remeasure, absolute, workers, note):
        if end.result is None:
            raise end.error or EvidenceError("no table was measured", where=str(tables[end.number]))
        contents[tables[end.number]], notes = end.result
        for text in notes:
            note(text)
    return contents.__getitem__


def _remeasure(table: Path) -> tuple[bytes, list[str]]:
    """Return a trial's table, measured again, and the notes on it."""
    notes: list[str] = []
    return _remeasured_table(table, notes.append), notes


def _remeasured_table(table: Path, note: Note) -> bytes:
    """Return a trial's table, measured again from its raw evidence."""
    from fieldkit.trial.stored import rebuild  # noqa: PLC0415 (loads all measuring code, which existing tables do not need)

    folder = table.parent
    if table.name != store.TRIAL_CSV or not (folder / PLAN_FILE).is_file():
        raise ConfigurationError(
            "a table alone has no raw evidence to rebuild from",
            where=str(table),
            remedy="name the folder of the trial, or leave out --rebuild",
        )
    plan = plans.read_plan(folder)
    note_differences(folder, note)
    return rows.to_csv(rebuild.measure_rows(folder, plan), plan.table).encode()


def note_differences(folder: Path, note: Note) -> None:
    """Show a note if evidence that is measured again differs from what was measured first."""
    from fieldkit.trial.stored import verification  # noqa: PLC0415 (as above)

    if differences := verification.differences(folder):
        note(f"{folder}: measured from changed evidence: {verification.summarize(differences)}")
