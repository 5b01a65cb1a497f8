"""Rows of trial.csv and summary.csv, the same whether a repeat has just ended or is read from disk years later."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from fieldkit.analysis import repeats, tables
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.core import columns, files
from fieldkit.core.columns import Column, Measured, Value, prefixed
from fieldkit.core.model import FIXED_ROLES, Role, in_order
from fieldkit.core.text import encodable
from fieldkit.steps.base import Nest, Step
from fieldkit.trial import store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan


def build(plan: Plan, attempt: Attempt, measured: Measured) -> Row:
    """Return the row of an attempt."""
    names = {role: robot.name for role, robot in plan.cast.items()}
    identity: dict[str, Value | None] = {
        "schema_version": columns.SCHEMA_VERSION,
        "trial": plan.trial,
        "procedure": plan.procedure.name,
        "scenario": plan.procedure.scenario,
        "topology": plan.topology,
        "backend": plan.backend,
        "distance_m": plan.distance_m,
        "distance": plan.distance,
        "protocol": attempt.repeat.protocol,
        "repeat": attempt.repeat.number,
        "attempt": attempt.number,
        "status": attempt.status,
        "reason": encodable(attempt.reason) or None,
        "started_utc_ns": attempt.started_utc_ns,
        "seed": plan.seed,
        "sender": names.get(Role.SENDER),
        "receiver": names.get(Role.RECEIVER),
        "relay": names.get(Role.RELAY),
        "others": " ".join(f"{role}={names[role]}" for role in in_order(names) if role not in FIXED_ROLES) or None,
        "profiles_sha256": plan.profiles_sha256,
        "procedure_sha256": plan.procedure_sha256,
        "code_sha256": plan.code_sha256,
    }
    return {name: value for name, value in identity.items() if value is not None} | dict(measured.values)


def in_words(plan: Plan, row: Row) -> str:
    """Return the most important numbers of a row for people: `IP loss 3.2 %, RTT 12.1 ms`.

    For how long a fault took a robot away comes behind what it did to others: where a line is too short for all, no
    other gap than that of a ping is left of it.
    """
    steps = sorted(
        (placed.step for placed in plan.procedure.walk()), key=lambda step: isinstance(step, Nest) and step.disturbs
    )
    return ", ".join(part for step in steps for part in _of_step(step, row))


def _of_step(step: Step, row: Row) -> Iterator[str]:
    """Yield the most important numbers of a step, with its name before the first, if it has one."""
    if not (name := step.prefix):
        yield from step.in_words(row)
        return
    begin = prefixed(name, "")
    own = {column.removeprefix(begin): value for column, value in row.items() if column.startswith(begin)}
    for index, part in enumerate(step.in_words(own)):
        yield part if index else f"{name}: {part}"


def to_csv(rows: Iterable[Row], table: Sequence[Column]) -> str:
    """Return rows as the text of a trial.csv of these columns, as `Plan.table` has them."""
    return head(table) + "".join(line(row, table) for row in rows)


def head(table: Sequence[Column]) -> str:
    """Return the first line of a trial.csv."""
    return columns.csv_line(column.name for column in table)


def line(row: Row, table: Sequence[Column]) -> str:
    """Return a row as its line of a trial.csv."""
    return columns.csv_line(row.get(column.name) for column in table)


def write_table(folder: Path, table: str) -> None:
    """Write trial.csv of a trial."""
    files.write(folder / store.TRIAL_CSV, table.encode())


def write_summary(folder: Path, plan: Plan, table: str) -> tuple[Cell, ...]:
    """Write summary.csv of a trial with this table and return what stands in it."""
    cells = aggregate(repeats.parse(table.encode(), plan.table))
    files.write(folder / store.SUMMARY_CSV, tables.to_csv(DEFAULT_BY, cells).encode())
    return cells
