"""Columns of the combined tables of trials with different procedures."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from fieldkit.analysis import table_files
from fieldkit.analysis.repeats import SOURCE
from fieldkit.analysis.table_index import TableFacts
from fieldkit.core import files
from fieldkit.core.columns import Column, with_step_name
from fieldkit.core.errors import ConfigurationError
from fieldkit.trial import frozen, store
from fieldkit.trial.columns import installed_columns, trial_columns
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import plans

Facts = Callable[[Path], TableFacts | None]
"""Function that returns the properties of a table that are known without reading it, or None."""


def no_facts(_: Path) -> None:
    """Return None, because no properties are known."""


def declared_columns(tables: Sequence[Path], facts: Facts = no_facts) -> tuple[Column, ...]:
    """Return all columns of the tables: first the columns of every trial, then others in the order of the tables.

    Columns that are not in every trial are declared in the `trial.yaml` next to the table. A column without such a
    declaration has the declaration of an installed kind of step; its name may start with the name of a step. If no
    kind declares the column either, it is read as text (`table_files.is_undeclared`).

    Args:
        tables: CSV files with the columns of trial.csv.
        facts: Properties that are already known.

    Raises:
        ConfigurationError: A table or a plan cannot be read, or plans contradict each other.
    """
    other_names_by_table = {table: names for table in tables if (names := _other_names_of(table, facts(table)))}
    planned_columns = merge_columns(
        (table.parent / PLAN_FILE, _planned_columns_of(table, facts(table))) for table in other_names_by_table
    )
    columns_by_name = {column.name: column for column in installed_columns()}
    other_names = dict.fromkeys(name for names in other_names_by_table.values() for name in names)
    return trial_columns(planned_columns.get(name) or _by_name(name, columns_by_name) for name in other_names)


def planned_columns(tables: Iterable[Path]) -> tuple[Column, ...]:
    """Return all columns in the plans of tables; tables without a plan are ignored.

    Raises:
        ConfigurationError: A plan cannot be read, or plans contradict each other.
        EvidenceError: For the same reasons as `plans.require_plain`.
    """
    plan_files = [table.parent / PLAN_FILE for table in tables if (table.parent / PLAN_FILE).is_file()]
    common_columns = set(trial_columns())
    declared = (
        (plan, [column for column in plans.read_plan(plan.parent).table if column not in common_columns])
        for plan in plan_files
    )
    return trial_columns(merge_columns(declared).values())


def merge_columns(declared: Iterable[tuple[Path, Iterable[Column]]]) -> dict[str, Column]:
    """Return the columns of several plans by name.

    Of compatible columns with the same name, the first is used, with bounds that include the bounds of all of them.

    Args:
        declared: Plans with their columns.

    Raises:
        ConfigurationError: Two plans declare incompatible columns with the same name.
    """
    merged: dict[str, tuple[Path, Column]] = {}
    for path, columns in declared:
        for column in columns:
            first_path, first = merged.setdefault(column.name, (path, column))
            if _type_of(first) != _type_of(column):
                raise ConfigurationError(
                    f"{column.name} is a different column here ({_description(column)}) "
                    f"than in {first_path} ({_description(first)})",
                    where=str(path),
                    remedy="combine only trials in which the column is the same",
                )
            if first.bounds != column.bounds:
                (low, high), (other_low, other_high) = first.possible_range, column.possible_range
                merged[column.name] = first_path, replace(first, bounds=(min(low, other_low), max(high, other_high)))
    return {name: column for name, (_, column) in merged.items()}


def _planned_columns_of(table: Path, known_facts: TableFacts | None) -> tuple[Column, ...]:
    return frozen_columns(table) if known_facts is None else frozen.from_json(known_facts.declarations)


def _other_names_of(table: Path, known_facts: TableFacts | None) -> tuple[str, ...]:
    return other_names(table_files.names(table) if known_facts is None else known_facts.names)


@lru_cache  # thousands of tables have the same columns
def other_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of a table's columns that are not in every trial."""
    # A header can have a column without a name. `SOURCE` is added when tables are combined.
    common_names = {column.name for column in trial_columns()} | {"", SOURCE}
    return tuple(name for name in names if name not in common_names)


def frozen_columns(table: Path) -> tuple[Column, ...]:
    """Return the columns in the plan next to a table; empty without a plan, or if the plan lists no columns.

    For a dataset (a folder), return the columns that it declares.

    Raises:
        ConfigurationError: The plan cannot be read.
    """
    if table.is_dir():
        from fieldkit.analysis import datasets  # noqa: PLC0415 (imports pandas if it is installed)

        return datasets.declared_columns(table)
    plan = table.parent / PLAN_FILE
    return plans.read_columns(plan) if plan.exists() and not files.unexpected_type(plan) else ()


def expectation_texts(table: Path) -> tuple[str, ...]:
    """Return the expectations in the plan of a trial's table. A CSV file without its trial has no expectations.

    Raises:
        ConfigurationError: The plan cannot be read.
    """
    plan = table.parent / PLAN_FILE
    has_plan = table.name == store.TRIAL_CSV and plan.is_file() and not files.unexpected_type(plan)
    return plans.read_expectations(plan) if has_plan else ()


def _by_name(name: str, installed_columns: Mapping[str, Column]) -> Column:
    """Return the column for a name, such as `rtt_loss` or `up.rtt_loss`, that no plan declares."""
    step, _, plain = name.rpartition(".")
    column = installed_columns.get(name)
    if column is None and plain in installed_columns:
        column = with_step_name(step, installed_columns[plain])
    return column if column and not column.declaration_error() else table_files.undeclared(name)


def _type_of(column: Column) -> tuple[object, ...]:
    """Return the properties that must be equal to combine two columns. They are equal for all columns of text."""
    figure = None if column.type is str else column.figure
    return column.unit, figure and (figure.kind, figure.arrived, figure.sent)


def _description(column: Column) -> str:
    return f"{column.unit}, {column.figure.kind}" if column.figure else column.unit
