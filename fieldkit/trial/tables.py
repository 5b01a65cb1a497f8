"""Columns of tables in which trials of procedures that differ stand beside each other."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fieldkit.analysis import repeats
from fieldkit.analysis.repeats import SOURCE
from fieldkit.core import files
from fieldkit.core.columns import Column, named, plain_name
from fieldkit.core.errors import ConfigurationError
from fieldkit.trial import frozen, store
from fieldkit.trial.columns import installed, trial_columns
from fieldkit.trial.plan import PLAN_FILE


def declared_in(tables: Sequence[Path]) -> tuple[Column, ...]:
    """Return every column of tables: those of every trial first, then others in the order in which tables have them.

    A column that is not in every trial is what the `trial.yaml` beside its table says, else what kinds of step that
    are installed say of its name, or of its name without that of a step; else a text, `repeats.is_undeclared`.

    Args:
        tables: CSV files with the columns of trial.csv.

    Raises:
        ConfigurationError: A table or a plan cannot be read, or plans contradict each other.
    """
    everywhere = {column.name for column in trial_columns()} | {"", SOURCE}
    others = {table: names for table in tables if (names := _others(table, everywhere))}
    said = united((table.parent / PLAN_FILE, _frozen(table)) for table in others)
    known = {column.name: column for column in installed()}
    found = dict.fromkeys(name for names in others.values() for name in names)
    return trial_columns(said.get(name) or _by_name(name, known) for name in found)


def planned(tables: Iterable[Path]) -> tuple[Column, ...]:
    """Return every column that the plans beside tables have; errors as `declared_in`, or a plan cannot be read."""
    plans = [table.parent / PLAN_FILE for table in tables if (table.parent / PLAN_FILE).is_file()]
    everywhere = set(trial_columns())
    found = (
        (plan, [column for column in store.read_plan(plan.parent).table if column not in everywhere])
        for plan in plans
    )
    return trial_columns(united(found).values())


def united(declared: Iterable[tuple[Path, Iterable[Column]]]) -> dict[str, Column]:
    """Return the columns of several plans by name; of two that say the same of a column the first is kept.

    Args:
        declared: Plans, and the columns that each has.

    Raises:
        ConfigurationError: Two plans mean different things by a name.
    """
    found: dict[str, tuple[Path, Column]] = {}
    for path, columns in declared:
        for column in columns:
            first, kept = found.setdefault(column.name, (path, column))
            if _makes(kept) != _makes(column):
                raise ConfigurationError(
                    f"{column.name} is another column here ({_in_words(column)}) than in {first} ({_in_words(kept)})",
                    where=str(path),
                    remedy="put together trials in which it is the same",
                )
            if kept.bounds != column.bounds:
                (low, high), (least, most) = kept.possible, column.possible
                found[column.name] = first, replace(kept, bounds=(min(low, least), max(high, most)))
    return {name: column for name, (_, column) in found.items()}


def _others(table: Path, everywhere: Iterable[str]) -> list[str]:
    return [name for name in repeats.names(table) if name not in everywhere]


def _frozen(table: Path) -> tuple[Column, ...]:
    """Return the columns that the plan beside a table has."""
    plan = table.parent / PLAN_FILE
    return frozen.read(plan) if plan.exists() and not files.foreign(plan) else ()


def _by_name(name: str, known: Mapping[str, Column]) -> Column:
    """Return what a column is that no plan knows."""
    step, _, plain = name.rpartition(".")
    column = known.get(name) or (known.get(plain_name(name)) and named(step, known[plain]))
    return column if column and not column.flaw() else repeats.undeclared(name)


def _makes(column: Column) -> tuple[object, ...]:
    """Return what must be the same for the values of two columns to be put together; texts always can be."""
    figure = None if column.type is str else column.figure
    return column.unit, figure and (figure.kind, figure.arrived, figure.sent)


def _in_words(column: Column) -> str:
    return f"{column.unit}, {column.figure.kind}" if column.figure else column.unit
