"""Tables of trials and their index: find the tables that are in the index, and add other tables to it."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from fieldkit.analysis import table_files, table_index
from fieldkit.analysis.parsing import Numbers, Texts
from fieldkit.analysis.table_index import Entry, TableFacts, TableIndex, TableStamp
from fieldkit.core.columns import Column
from fieldkit.core.errors import FieldkitError
from fieldkit.core.executors import Workers
from fieldkit.core.tasks import completed
from fieldkit.trial import frozen
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored.tables import expectation_texts, frozen_columns, other_names

MIN_TABLES: Final = 100
"""Smallest number of tables for which an index is used. Fewer tables are read faster without an index."""
MIN_NEW: Final = 20
"""Smallest number of new or changed tables for which an index is written again. Fewer are read from their files."""
MAX_TABLE_BYTES: Final = 1 << 25
"""Maximum size of a table in the index."""
_MIN_PARALLEL_PLANS: Final = 200
"""Smallest number of plans that are read in parallel. Reading a plan takes 20 ms; starting processes takes 1 s."""

Note = Callable[[str], None]
"""Function that shows a sentence to the user."""


@dataclass(frozen=True, eq=False)
class IndexedTables:
    """The tables that are in an index, and the tables that must be added to it.

    Attributes:
        path: File of the index, which may not exist yet; None if no index is used.
        index: Content of the index; empty if the file does not exist yet.
        entries: Entries of the tables that are in the index, by table.
        new: Stamps and properties of the tables that `write` adds to the index, by table.
    """

    path: Path | None = None
    index: TableIndex = field(default_factory=TableIndex)
    entries: Mapping[Path, Entry] = field(default_factory=dict)
    new: Mapping[Path, tuple[TableStamp, TableFacts]] = field(default_factory=dict)

    @cached_property
    def tables(self) -> frozenset[Path]:
        """The tables whose rows are in the index. An invalid table has an entry with a negative number of rows."""
        return frozenset(table for table, entry in self.entries.items() if entry.rows >= 0)

    def facts(self, table: Path) -> TableFacts | None:
        """Return the properties of a table, or None if the table is neither in the index nor in `new`."""
        if table in self.new:
            return self.new[table][1]
        return self.entries[table].facts if table in self.entries else None

    def read(
        self, tables: Sequence[Path], declared: Mapping[str, Column]
    ) -> tuple[dict[str, Numbers], dict[str, Texts], list[int]] | None:
        """Return the rows of tables, as `table_files.IndexedRows`, or None if the types of columns have changed."""
        if not self.index.has_types(declared.values()):
            return None
        entries = [self.entries[table] for table in tables]
        return *self.index.read(entries, declared), [entry.rows for entry in entries]


NO_INDEX: Final = IndexedTables()


def find(tables: Iterable[Path], workers: Workers, note: Note) -> IndexedTables:
    """Return the tables that are in the index in the user's cache, and the properties of the tables to add.

    Args:
        tables: The tables.
        workers: Processes that read the plans.
        note: Receives a note if the index cannot be used.
    """
    absolute = {table: table.absolute() for table in tables if table.suffix == ".csv"}
    if len(absolute) < MIN_TABLES:
        return NO_INDEX
    path = table_index.index_path(list(map(str, absolute.values())))
    try:
        index = table_index.load(path)
    except OSError as error:
        note(_no_index_note(path, error))
        return NO_INDEX
    now_ns = time.time_ns()
    entries, new = {}, {}
    for table, name in absolute.items():
        stamp = _stamp(name)
        if stamp is None:
            continue
        if stamp in index.entries:
            entries[table] = index.entries[stamp]
        elif _can_be_indexed(stamp, now_ns):
            new[table] = stamp
    indexed = IndexedTables(path, index, entries)
    if len(new) < (MIN_NEW if index.entries else MIN_TABLES):
        return indexed
    facts = _facts(list(new), workers, note)
    return replace(indexed, new={table: (new[table], facts[table]) for table in facts})


def _no_index_note(path: Path, error: OSError) -> str:
    return f"{path}: {error.strerror or error}; tables are read without an index, which takes longer (see --no-index)"


def _can_be_indexed(stamp: TableStamp, now_ns: int) -> bool:
    """Return True if a table is not too large, and neither the table nor its plan has just changed."""
    table_stamp, _ = stamp
    return table_stamp.size <= MAX_TABLE_BYTES and all(part is None or part.is_settled(now_ns) for part in stamp)


def _facts(tables: Sequence[Path], workers: Workers, note: Note) -> dict[Path, TableFacts]:
    """Return the properties of valid tables. Invalid tables are omitted; reading them later raises the error."""
    names: dict[Path, tuple[str, ...]] = {}
    for table in tables:
        with suppress(FieldkitError):
            names[table] = table_files.names(table)
    with_plan = [table for table in names if other_names(names[table])]
    if len(with_plan) < _MIN_PARALLEL_PLANS:
        workers = Workers(jobs=1)
    declarations = dict.fromkeys(names, "")
    absolute = [table.absolute() for table in with_plan]  # workers of a cluster have another working directory
    for end in completed(_declarations, absolute, workers, note):
        if end.result is None:
            del declarations[with_plan[end.number]]
        else:
            declarations[with_plan[end.number]] = end.result
    facts = {}
    for table, text in declarations.items():
        with suppress(FieldkitError, OSError):
            facts[table] = TableFacts(names[table], text, expectation_texts(table))
    return facts


def _declarations(table: Path) -> str:
    """Return the columns in the plan next to a table, as JSON."""
    return frozen.to_json(frozen_columns(table))


def write(indexed: IndexedTables, columns: Sequence[Column], note: Note) -> IndexedTables:
    """Add the new tables to the index, and return the tables that are in it. Without new tables, nothing is written.

    Args:
        indexed: The tables, as `find` returned them.
        columns: Columns of all tables.
        note: Receives a note if the index cannot be written.
    """
    if indexed.path is None or not indexed.new:
        return indexed
    declared = {column.name: column for column in columns}
    index = indexed.index if indexed.index.has_types(columns) else TableIndex()
    types = {**index.types, **{name: table_index.type_name(column) for name, column in declared.items()}}
    try:
        with table_index.replacing(indexed.path, types) as writer:
            if index.entries:
                writer.copy(index, _kept_entries(indexed))
            for arrays, counts in table_files.typed_tables(_unchanged(indexed.new), declared):
                # `writer.add` sets the start of each table, which is 0 here.
                new_entries = [Entry(str(table.absolute()), *indexed.new[table], 0, rows) for table, rows in counts]
                writer.add(arrays, new_entries)
        written = table_index.load(indexed.path)
    except OSError as error:
        note(_no_index_note(indexed.path, error))
        return replace(indexed, new={})
    stamps = {table: entry.stamp for table, entry in indexed.entries.items()}
    stamps |= {table: stamp for table, (stamp, _) in indexed.new.items()}
    entries = {table: written.entries[stamp] for table, stamp in stamps.items() if stamp in written.entries}
    return IndexedTables(indexed.path, written, entries)


def _kept_entries(indexed: IndexedTables) -> list[Entry]:
    """Return the entries of an index for tables that have not changed."""
    requested = {entry.stamp for entry in indexed.entries.values()}
    return [
        entry
        for entry in indexed.index.entries.values()
        if entry.stamp in requested or entry.stamp == _stamp(Path(entry.path))
    ]


def _unchanged(new: Mapping[Path, tuple[TableStamp, TableFacts]]) -> Iterator[tuple[Path, bytes]]:
    """Yield the tables and their bytes if neither the table nor its plan changed since its stamp was read."""
    for table, (stamp, _) in new.items():
        with suppress(OSError):
            content = table.read_bytes()
            if _stamp(table.absolute()) == stamp:
                yield table, content


def _stamp(table: Path) -> TableStamp | None:
    """Return the stamps (size and time of change) of a table and its plan, or None if the table cannot be indexed."""
    return table_index.stamp(table, table.parent / PLAN_FILE)
