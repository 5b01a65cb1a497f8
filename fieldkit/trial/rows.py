"""Rows of trial.csv and summary.csv. Measuring an attempt again with the same code gives the same row."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import filterfalse
from pathlib import Path
from typing import Final

from fieldkit.analysis import repeats, result_tables
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.core import columns, files
from fieldkit.core.columns import Column, Measured, Value, step_prefixed
from fieldkit.core.events import NOTHING_ARRIVED
from fieldkit.core.model import FIXED_ROLES, Role, sort_roles
from fieldkit.core.text import encodable
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.steps.base import Step
from fieldkit.steps.capabilities import Summarizes
from fieldkit.steps.nest import Nest
from fieldkit.trial import gates, store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan

LOSSES: Final = frozenset(
    (
        "file_loss",
        "ip_loss",
        "datagram_loss",
        "tcp_byte_loss",
        "rtt_loss",
        "topic_loss",
        "video_loss",
        "iperf3_loss",
        "mavlink_loss",
    )
)
"""Columns that are 1 if nothing arrived. Some are missing if a transfer sent no packet."""


def build(plan: Plan, attempt: Attempt, measured: Measured) -> Row:
    """Return the row of an attempt."""
    names = {role: robot.name for role, robot in plan.cast.items()}
    identity: dict[str, Value | None] = {
        "schema_version": columns.SCHEMA_VERSION,
        "trial": plan.trial,
        "procedure": plan.procedure.name,
        "scenario": plan.procedure.scenario,
        "topology": plan.topology,
        "backend": plan.backend_with_simulators,
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
        "others": " ".join(f"{role}={names[role]}" for role in sort_roles(names) if role not in FIXED_ROLES) or None,
        "profiles_sha256": plan.profiles_sha256,
        "procedure_sha256": plan.procedure_sha256,
        "code_sha256": plan.code_sha256,
    }
    return {name: value for name, value in identity.items() if value is not None} | dict(measured.values)


def measure_row(plan: Plan, attempt: Attempt, evidence: AttemptEvidence) -> Row:
    """Return the row of an attempt, measured from its evidence. Values without evidence are missing."""
    return build(plan, attempt, gates.judge(plan, attempt.repeat, evidence).measured)


def describe(plan: Plan, row: Row) -> str:
    """Return the most important numbers of a row for display: `IP packet loss 3.2 %, RTT 12.1 ms`.

    Losses come first, then other numbers. In both groups, the numbers of faults are the last.
    """
    steps = sorted(
        (placed.step for placed in plan.procedure.walk()), key=lambda step: isinstance(step, Nest) and step.disturbs
    )
    parts_by_step = [(step.prefix, list(_step_numbers(step, row))) for step in steps]
    losses = [text for name, parts in parts_by_step for text in _with_step_name(name, filter(_is_loss, parts))]
    others = [text for name, parts in parts_by_step for text in _with_step_name(name, filterfalse(_is_loss, parts))]
    return ", ".join([*([NOTHING_ARRIVED] if _lost_all(row) else []), *losses, *others])


def _step_numbers(step: Step, row: Row) -> Iterator[str]:
    """Return the most important numbers of a step, from the columns with the prefix of the step."""
    prefix = step_prefixed(step.prefix, "")
    values = {column.removeprefix(prefix): value for column, value in row.items() if column.startswith(prefix)}
    return step.summary(values) if isinstance(step, Summarizes) else iter(())


def _with_step_name(name: str, parts: Iterable[str]) -> Iterator[str]:
    """Yield the parts of a text; the name of their step precedes the first part."""
    for index, part in enumerate(parts):
        yield f"{name}: {part}" if name and not index else part


def _is_loss(part: str) -> bool:
    return "loss" in part.split()


def _lost_all(row: Row) -> bool:
    """Return True if the row has loss columns and all of them are 1."""
    losses = [value for name, value in row.items() if columns.plain_name(name) in LOSSES]
    return bool(losses) and all(isinstance(loss, float | int) and loss >= 1 for loss in losses)


def to_csv(rows: Iterable[Row], table: Sequence[Column]) -> str:
    """Return the text of a trial.csv with these rows and columns; `table` is `Plan.table`."""
    return header(table) + "".join(line(row, table) for row in rows)


def header(table: Sequence[Column]) -> str:
    """Return the header line of a trial.csv."""
    return columns.csv_line(column.name for column in table)


def line(row: Row, table: Sequence[Column]) -> str:
    """Return the line of a row in a trial.csv."""
    return columns.csv_line(row.get(column.name) for column in table)


def write_table(folder: Path, csv_text: str) -> None:
    """Write trial.csv of a trial."""
    files.write(folder / store.TRIAL_CSV, csv_text.encode())


def summary(folder: Path, plan: Plan, csv_text: str) -> tuple[Cell, ...]:
    """Return the summary of a trial. `csv_text` is the content of its trial.csv.

    Raises:
        EvidenceError: A value does not match the declaration of its column.
    """
    return aggregate(repeats.parse(csv_text.encode(), plan.table, str(folder / store.TRIAL_CSV)))


def write_summary(folder: Path, plan: Plan, csv_text: str) -> tuple[Cell, ...]:
    """Write summary.csv of a trial and return its cells. Arguments and errors are those of `summary`."""
    cells = summary(folder, plan, csv_text)
    files.write(folder / store.SUMMARY_CSV, result_tables.to_csv(DEFAULT_BY, cells).encode())
    return cells
