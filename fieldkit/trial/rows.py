"""Rows of trial.csv and summary.csv, the same whether a repeat has just ended or is read from disk years later."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final

from fieldkit.analysis import repeats, tables
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.core import columns, files
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.model import Role
from fieldkit.measure.evidence import lateness
from fieldkit.steps import kinds
from fieldkit.trial import store
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan

IDENTITY: Final = columns.columns(
    0,
    ("schema_version", "count", "Version of these columns, of the fieldkit that measured the row."),
    ("trial", "text", "Name of the trial's folder."),
    ("procedure", "text", "Procedure."),
    ("scenario", "text", "los or nlos."),
    ("topology", "text", "master or masterless."),
    ("backend", "text", "Where the robots came from."),
    ("distance_m", "m", "Distance."),
    ("distance", "text", "Distance as the operator wrote it."),
    ("protocol", "text", "tcp or udp."),
    ("repeat", "count", "Number of the repeat, from 1, per protocol."),
    (
        "attempt",
        "count",
        "Number of the attempt, from 1; above 1 after a void one. The last one allowed is failed, not void.",
    ),
    ("status", "text", "valid, void (evidence not whole) or failed."),
    ("reason", "text", "Why it is not valid; empty when it is."),
    ("started_utc_ns", "ns", "Start by the laptop's clock, nanoseconds since 1970 UTC."),
    ("seed", "count", "The trial's seed."),
    ("sender", "text", "Robot in the role sender."),
    ("receiver", "text", "Robot in the role receiver."),
    ("relay", "text", "Robot whose access point relays; empty when masterless."),
    ("profiles_sha256", "hash", "First 16 digits of the hash over the robots' profiles and roles."),
    ("procedure_sha256", "hash", "First 16 digits of the hash of the procedure: its file and --record."),
    ("code_sha256", "hash", "First 16 digits of the hash over fieldkit's own source."),
)
"""What tells an attempt from others; the columns that its evidence fills follow."""

Row = Mapping[str, Value]
"""Values of one attempt by column; a column that is missing is not there."""


@cache
def measures() -> tuple[Column, ...]:
    """Return every column that evidence fills: the testbed's own, and those of every kind of step."""
    declared = [*lateness.COLUMNS, *(column for kind in kinds.known().values() for column in kind.columns)]
    return tuple(sorted(dict.fromkeys(declared), key=lambda column: column.rank))


@cache
def trial_columns() -> tuple[Column, ...]:
    """Return the columns of trial.csv in order."""
    return (*IDENTITY, *measures())


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
        "reason": attempt.reason or None,
        "started_utc_ns": attempt.started_utc_ns,
        "seed": plan.seed,
        "sender": names.get(Role.SENDER),
        "receiver": names.get(Role.RECEIVER),
        "relay": names.get(Role.RELAY),
        "profiles_sha256": plan.profiles_sha256,
        "procedure_sha256": plan.procedure_sha256,
        "code_sha256": plan.code_sha256,
    }
    return {name: value for name, value in identity.items() if value is not None} | dict(measured.values)


def in_words(plan: Plan, row: Row) -> str:
    """Return the most important numbers of a row for people: `IP loss 3.2 %, RTT 12.1 ms`."""
    return ", ".join(part for placed in plan.procedure.walk() for part in placed.step.in_words(row))


def to_csv(rows: Sequence[Row]) -> str:
    """Return rows as the text of a trial.csv."""
    names = [column.name for column in trial_columns()]
    return columns.csv_text(names, ([row.get(name) for name in names] for row in rows))


def write_rows(folder: Path, rows: Sequence[Row]) -> None:
    """Write trial.csv of a trial."""
    files.write(folder / store.TRIAL_CSV, to_csv(rows).encode())


def write_summary(folder: Path, rows: Sequence[Row]) -> tuple[Cell, ...]:
    """Write summary.csv of a trial and return what stands in it."""
    cells = aggregate(repeats.of_rows(rows, trial_columns()))
    files.write(folder / store.SUMMARY_CSV, tables.to_csv(DEFAULT_BY, cells).encode())
    return cells
