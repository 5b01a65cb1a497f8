"""Find trials and CSV files at paths, as commands and the Python API take them, and read their repeats."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

from fieldkit.analysis import expectations, repeats
from fieldkit.analysis.duplicates import deduplicated
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.quantities import Quantity, quantities
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.analysis.words import worded
from fieldkit.core import files
from fieldkit.core.columns import Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, nearest, typed
from fieldkit.trial import frozen, rows, store, tables
from fieldkit.trial.plan import PLAN_FILE

Note = Callable[[str], None]
"""Shows a sentence on something that is left out, or not as one would think."""


@dataclass(frozen=True)
class Sources:
    """Tables that were found at some paths.

    Attributes:
        where: The paths, for messages.
        tables: Each once.
        columns: What any of them has.
        rebuild: Whether raw evidence is measured again instead; nothing is written.
        note: Where notes go.
    """

    where: str
    tables: Sequence[Path]
    columns: Sequence[Column]
    rebuild: bool
    note: Note

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """What figures can be made of, by name and in order."""
        return {quantity.name: quantity for quantity in quantities(self.columns)}

    @cached_property
    def words(self) -> Mapping[str, Column]:
        """Columns whose words are counted, by name and in order."""
        return {column.name: column for column in worded(self.columns)}

    def condition(self, text: str, *, asked: str = "--by") -> tuple[str, ...]:
        """Return the columns that tell one condition from another, each once.

        Args:
            text: Names with commas between them.
            asked: The option or argument by which; for the message.

        Raises:
            ConfigurationError: There is no such column.
        """
        names = tuple(name.strip() for name in text.split(","))
        known = [*(column.name for column in self.columns), SOURCE]
        for name in names:
            if name not in known:
                raise ConfigurationError(
                    f"{asked}: there is no column {name!r}",
                    remedy=nearest(name, known, "fieldkit columns lists them"),
                )
        return tuple(dict.fromkeys(names))

    def chosen(
        self, names: Collection[str], *, asked: str = "--quantity"
    ) -> tuple[list[Quantity] | None, list[Column] | None]:
        """Return the quantities and the columns of words of some names, each None where no name is given: for all.

        Raises:
            ConfigurationError: As `quantity`, which tells of `asked`.
        """
        if not names:
            return None, None
        quantities = [self.quantity(name, asked=asked) for name in names if name not in self.words]
        return quantities, [self.words[name] for name in names if name in self.words]

    def quantity(self, name: str, *, asked: str = "--quantity") -> Quantity:
        """Return the quantity of a name; `asked` as in `condition`.

        Raises:
            ConfigurationError: There is none.
        """
        if name not in self.quantities:
            raise ConfigurationError(
                f"{asked}: repeats are not put together over {name!r}",
                remedy=nearest(name, self.quantities, f"it is one of: {', '.join(self.quantities)}"),
            )
        return self.quantities[name]

    def expectations(self) -> Mapping[str, Sequence[Expectation]]:
        """Return what trials expect of their figures, by their source; of a table alone nothing is known.

        Raises:
            ConfigurationError: A plan cannot be read.
        """
        found: dict[str, list[Expectation]] = {}
        for folder in (table.parent for table in self.tables if table.name == store.TRIAL_CSV):
            if (folder / PLAN_FILE).is_file() and not files.foreign(folder / PLAN_FILE):
                for text in frozen.expected(folder / PLAN_FILE):
                    try:
                        one = expectations.parse(text, self.quantities.values())
                    except ConfigurationError as error:  # of an earlier version, or edited
                        self.note(f"{folder}: what it expects is left out: {error.what}")
                    else:
                        found.setdefault(str(folder), []).append(one)
        return found

    def read(
        self, columns: Collection[str] | None = None, *, also: Collection[str] = (), undeclared: bool = False
    ) -> Repeats:
        """Return the attempts in the tables, each once, as `repeats.read`.

        Args:
            columns: Columns that are needed, None for all that are declared.
            also: Columns that are needed whether they are declared or not.
            undeclared: Whether to keep all of those that are not; a note names them.

        Raises:
            ConfigurationError: A file is none of ours, two contradict each other, or there is no evidence to rebuild
                from.
            EvidenceError: A line or a journal is damaged, or no repeat has ended.
        """
        others = [column.name for column in self.columns if repeats.is_undeclared(column)]
        if others and undeclared:
            self.note(f"kept as text, because no kind of step that is installed declares it: {', '.join(others)}")
        if columns is None:
            columns = {column.name for column in self.columns} - (set() if undeclared else set(others) - set(also))
        content = partial(_measured, note=self.note) if self.rebuild else Path.read_bytes
        found, notes = deduplicated(repeats.read(self.tables, self.columns, columns, content))
        for note in notes:
            self.note(note)
        if not len(found):
            begun = next((table.parent for table in self.tables if (table.parent / PLAN_FILE).is_file()), None)
            raise EvidenceError(
                "no repeat has ended yet",
                where=self.where,
                remedy=typed("fieldkit", "resume", begun) if begun else "name a trial that ran",
            )
        return found


def find(paths: Sequence[Path], note: Note, *, rebuild: bool = False) -> Sources:
    """Return the tables of the trials and CSV files at or below `paths`, and what their columns are.

    Args:
        paths: Folders of trials, CSV files with the columns of trial.csv, or folders with trials below.
        note: Where notes go.
        rebuild: Whether to measure raw evidence again.

    Raises:
        ConfigurationError: A path does not exist or has no trial below, or as `tables.declared_in`.
        EvidenceError: No trial has its table.
    """
    return find_each([paths], note, rebuild=rebuild)[0]


def find_each(runs: Sequence[Sequence[Path]], note: Note, *, rebuild: bool = False) -> list[Sources]:
    """Return what is at the paths of each run, as `find`; the columns are those of all runs."""
    found = [_found(paths, note, rebuild=rebuild) for paths in runs]
    every = [table for one in found for table in one]
    columns = tables.planned(every) if rebuild else tables.declared_in(every)
    return [Sources(_where(paths), one, columns, rebuild, note) for paths, one in zip(runs, found, strict=True)]


def _found(paths: Sequence[Path], note: Note, *, rebuild: bool) -> list[Path]:
    found = {_identity(table): table for path in paths for table in _tables(path, note, rebuild=rebuild)}
    if not found:
        remedy = "add --rebuild, or make each as the notes above say"
        raise EvidenceError(f"no trial there has its {store.TRIAL_CSV}", where=_where(paths), remedy=remedy)
    return list(found.values())


def _where(paths: Sequence[Path]) -> str:
    return " ".join(map(str, paths))


def _tables(path: Path, note: Note, *, rebuild: bool) -> Iterator[Path]:
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
            note(f"{folder / store.TRIAL_CSV}: {what}, and is left out")
        elif rebuild or (folder / store.TRIAL_CSV).is_file():
            yield folder / store.TRIAL_CSV
        else:
            how = typed("fieldkit", "rebuild", folder)
            note(f"{folder}: has no {store.TRIAL_CSV} and is left out; to make it: {how}")


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


def _measured(table: Path, note: Note) -> bytes:
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
    note_differences(folder, note)
    return rows.to_csv(rebuild.measured(folder, plan), plan.table).encode()


def note_differences(folder: Path, note: Note) -> None:
    """Note evidence that is measured again and is not what was measured first."""
    from fieldkit.trial import manifest  # noqa: PLC0415 (as above)

    if found := manifest.differences(folder):
        note(f"{folder}: measured as it is now, which is not as it was kept: {manifest.few(found)}")
