"""Find trials and CSV files and read their repeats, for commands and the Python API."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
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
from fieldkit.trial import store
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import indexed_tables, tables
from fieldkit.trial.stored.indexed_tables import NO_INDEX, IndexedTables

ALL_PROCESSORS: Final = Workers()

Note = Callable[[str], None]
"""Function that shows a sentence about data that is omitted or treated in an unexpected way."""


@dataclass(frozen=True)
class Sources:
    """The tables at some paths.

    Attributes:
        where: The paths, for messages.
        tables: The tables, without duplicates.
        columns: The columns of all tables.
        rebuild: True to measure the raw evidence again instead of reading the tables. Nothing is written.
        note: Receives notes.
        workers: Processes that measure raw evidence again.
        row_filter: Selects rows; None for all rows.
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
        """The text columns whose values are counted, by name and in order."""
        return {column.name: column for column in word_columns(self.columns)}

    def condition(self, text: str, *, option: str = "--by") -> tuple[str, ...]:
        """Return the columns that define a condition, without duplicates.

        Repeats with equal values in these columns have the same condition and are aggregated together.

        Args:
            text: Comma-separated names.
            option: Option or argument with these names, for the message.

        Raises:
            ConfigurationError: There is no such column.
        """
        names = tuple(name.strip() for name in text.split(","))
        allowed_names = [*(column.name for column in self.columns), SOURCE]
        for name in names:
            if name not in allowed_names:
                raise ConfigurationError(
                    f"{option}: there is no column {name!r}",
                    remedy=did_you_mean(name, allowed_names, "fieldkit columns lists them"),
                )
        return tuple(dict.fromkeys(names))

    @cached_property
    def sweep_columns(self) -> Mapping[str, str]:
        """The columns that define a condition of a sweep (co-simulations with varied parameters).

        Maps each column to the column that has the same values as the user typed them (`datasets.condition`). The
        mapping is empty if a table is not a sweep.
        """
        if not all(table.is_dir() for table in self.tables):
            return {}
        from fieldkit.analysis import datasets  # noqa: PLC0415 (imports pandas if it is installed)

        return {name: text for table in self.tables for name, text in datasets.condition(table).items()}

    @property
    def sweep_condition(self) -> tuple[str, ...]:
        """The names of the columns in `sweep_columns`: the flow, then the parameters that the sweep varies."""
        return tuple(self.sweep_columns)

    def select(
        self, names: Collection[str], *, option: str = "--quantity"
    ) -> tuple[list[Quantity] | None, list[Column] | None]:
        """Return the quantities and the word columns with some names.

        Both are None, which means all, if there are no names.

        Raises:
            ConfigurationError: For the same reasons as `quantity`, with `option` in the message.
        """
        if not names:
            return None, None
        quantities = [self.quantity(name, option=option) for name in names if name not in self.words]
        return quantities, [self.words[name] for name in names if name in self.words]

    def quantity(self, name: str, *, option: str = "--quantity") -> Quantity:
        """Return the quantity with a name; see `condition` for `option`.

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
        """Return the expectations of trials by source folder. A CSV file without its trial has no expectations.

        Raises:
            ConfigurationError: A plan cannot be read.
        """
        expectations_by_source: dict[str, list[Expectation]] = {}
        for table in self.tables:
            facts = self.indexed.facts(table)
            for text in tables.expectation_texts(table) if facts is None else facts.expected:
                try:
                    expectation = expectations.parse(text, self.quantities.values())
                except ConfigurationError as error:  # the plan is of an earlier version, or was edited
                    self.note(f"{table.parent}: an expectation is omitted: {error.what}")
                else:
                    expectations_by_source.setdefault(str(table.parent), []).append(expectation)
        return expectations_by_source

    def read(
        self, columns: Collection[str] | None = None, *, also: Collection[str] = (), undeclared: bool = False
    ) -> Repeats:
        """Return the attempts in the tables that the row filter selects, without duplicates; see `table_files.read`.

        Args:
            columns: Columns to read, besides the columns of the row filter; None for all declared columns.
            also: With `columns` None, further columns to read, even if they are not declared.
            undeclared: With `columns` None, True to read all undeclared columns; a note lists them.

        Raises:
            ConfigurationError: A file is not a table of repeats, two tables contradict each other, or there is no
                evidence to rebuild from.
            EvidenceError: A line or a journal is damaged, no repeat has ended, or the row filter selects no attempt.
        """
        undeclared_names = [column.name for column in self.columns if table_files.is_undeclared(column)]
        if undeclared_names and undeclared:
            names_text = ", ".join(undeclared_names)
            self.note(f"read as text, because no installed kind of step declares it: {names_text}")
        if columns is None:
            omitted = set() if undeclared else set(undeclared_names) - set(also)
            columns = {column.name for column in self.columns} - omitted
        if self.row_filter is not None:
            columns = {*columns, *self.row_filter.names}
        content: Callable[[Path], bytes] = Path.read_bytes
        if self.rebuild:
            from fieldkit.trial.stored import remeasured  # noqa: PLC0415 (loads all measuring code)

            content = remeasured.table_reader(self.tables, self.workers, self.note)
        attempts, notes = deduplicated(self._rows(columns, content))
        for note in notes:
            self.note(note)
        if not len(attempts):
            started_trial = next(
                (table.parent for table in self.tables if (table.parent / PLAN_FILE).is_file()), None
            )
            raise EvidenceError(
                "no repeat has ended yet",
                where=self.where,
                remedy=shell_command("fieldkit", "resume", started_trial)
                if started_trial
                else "name a trial that ran",
            )
        return attempts if self.row_filter is None else self._selected_rows(attempts, self.row_filter)

    def _rows(self, columns: Collection[str], content: Callable[[Path], bytes]) -> Repeats:
        if self.indexed.tables:
            # This error is not reported: if several tables are invalid, reading without the index may report another.
            with suppress(FieldkitError):
                return table_files.read(self.tables, self.columns, columns, content, self.indexed)
        return table_files.read(self.tables, self.columns, columns, content)

    def _selected_rows(self, attempts: Repeats, row_filter: RowFilter) -> Repeats:
        selected = attempts.where(row_filter.mask(attempts))
        if not len(selected):
            raise EvidenceError(
                f"none of {format_count(len(attempts), 'attempt')} satisfies --where {row_filter.text}",
                where=self.where,
                remedy="a missing value satisfies no comparison; fieldkit columns show NAME describes a column",
            )
        return selected

    def with_filter(self, text: str) -> "Sources":
        """Return these sources with only the rows that satisfy an expression, or with all rows if it is empty.

        Raises:
            ConfigurationError: For the same reasons as `parse_filter`.
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
    """Return the tables at `paths`: CSV files, and the tables of trials and sweeps at or below folders.

    Args:
        paths: Folders of trials or sweeps, folders with them at any depth, or CSV files with the columns of
            trial.csv.
        note: Receives notes.
        rebuild: True to measure raw evidence again.
        workers: Processes that measure evidence and read plans.
        use_index: True to read many tables from an index, which does not change the result.

    Raises:
        ConfigurationError: A path does not exist or contains no trial, `rebuild` is True and there is a sweep, or the
            columns cannot be determined; see `tables.declared_columns`.
        EvidenceError: No trial has a table.
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
    """Return the sources of each run; see `find`. All of them have the columns of all runs.

    A run is a group of paths, for example one side of a comparison.
    """
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
    tables_by_identity = {_identity(table): table for path in paths for table in _tables(path, note, rebuild=rebuild)}
    if not tables_by_identity:
        remedy = "add --rebuild, or run the commands in the notes above"
        raise EvidenceError(f"no trial there has a {store.TRIAL_CSV}", where=_paths_text(paths), remedy=remedy)
    return list(tables_by_identity.values())


def _paths_text(paths: Sequence[Path]) -> str:
    return " ".join(map(str, paths))


def _tables(path: Path, note: Note, *, rebuild: bool) -> Iterator[Path]:
    """Yield the path itself if it is a file, otherwise the table of each trial and sweep at or below the folder.

    The table of a sweep is a folder.
    """
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
            remedy=f"name the folder that contains trials, or CSV files: {shell_command(path)}/*.csv",
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
                note(f"{folder}: has no results yet; run the command of the sweep again")
        elif not rebuild and (reason := files.unexpected_type(table)):
            note(f"{table}: {reason}; it is omitted")
        elif rebuild or table.is_file():
            yield table
        else:
            command = shell_command("fieldkit", "rebuild", folder)
            note(f"{folder}: has no {store.TRIAL_CSV} and is omitted; to create it: {command}")


def trial_folders(path: Path) -> list[Path]:
    """Return the folders of trials and sweeps at or below a path; none if the path is not a folder."""
    return [Path(folder) for folder in _trials(str(path), set())] if path.is_dir() else []


_IDENTIFYING_FILES: Final = frozenset({PLAN_FILE, store.TRIAL_CSV, laptop_files.SWEEP})
"""Files that identify the folder of a trial or a sweep."""


def _trials(folder: str, visited: set[tuple[int, int]]) -> Iterator[str]:
    """Yield the folders of trials and sweeps at or below a folder, sorted.

    Links are followed. Each folder is visited once. Names that start with `.` or end with `.partial` are omitted.
    """
    status = os.stat(folder)  # noqa: PTH116 (a path object per folder takes longer than the call)
    if (status.st_dev, status.st_ino) in visited:
        return
    visited.add((status.st_dev, status.st_ino))
    with os.scandir(folder) as scan:
        entries = sorted(scan, key=lambda entry: entry.name)
    if not _IDENTIFYING_FILES.isdisjoint(entry.name for entry in entries):
        yield folder
        return
    for entry in entries:
        if not entry.name.startswith(".") and not entry.name.endswith(".partial") and entry.is_dir():
            yield from _trials(entry.path, visited)


def _identity(table: Path) -> object:
    """Return the identity of a table, which is the same for all paths to it."""
    is_folder = table.name == store.TRIAL_CSV or table.is_dir()
    status = (table.parent if is_folder else table).stat()
    return status.st_dev, status.st_ino
