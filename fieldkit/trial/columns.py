"""The columns of trial.csv: some identify an attempt, and the others are declared by steps and the testbed."""

from collections.abc import Collection, Iterable, Mapping
from functools import cache
from typing import Final

from fieldkit.core import columns
from fieldkit.core.columns import Column, Value, with_step_name
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FIXED_ROLES, Role, sort_roles
from fieldkit.measure.evidence import link, oracle_delays, outage_columns
from fieldkit.measure.robot_state import state_columns
from fieldkit.steps.base import Step, step_types

IDENTITY: Final = columns.columns(
    0,
    ("schema_version", "count", "Version of the columns in the fieldkit that measured the row."),
    ("trial", "text", "Name of the trial's folder."),
    ("procedure", "text", "Name of the procedure."),
    ("scenario", "text", "los (line of sight) or nlos (no line of sight)."),
    ("topology", "text", "master (packets pass a relay) or masterless."),
    (
        "backend",
        "text",
        "Backend that provided the robots; on a co-simulation with physics, network and sync policy in brackets.",
    ),
    ("distance_m", "m", "Planned distance."),
    ("distance", "text", "Distance as the operator wrote it."),
    ("protocol", "text", "Transport protocol: tcp or udp."),
    ("repeat", "count", "Number of the repeat, from 1, per protocol."),
    (
        "attempt",
        "count",
        "Number of the attempt, from 1; above 1 after a void attempt. The last allowed attempt is valid or failed.",
    ),
    ("status", "text", "valid, void (evidence is incomplete) or failed."),
    ("reason", "text", "Reason why the attempt is not valid; empty if it is valid."),
    ("started_utc_ns", "ns", "Start by the laptop's clock, nanoseconds since 1970 UTC."),
    ("seed", "count", "The trial's seed."),
    ("sender", "text", "Robot in the role sender."),
    ("receiver", "text", "Robot in the role receiver."),
    ("relay", "text", "Robot whose access point relays; empty if masterless."),
    ("profiles_sha256", "hash", "First 16 digits of the hash over the robots' profiles and roles."),
    ("procedure_sha256", "hash", "First 16 digits of the hash of the procedure: its file and --record."),
    ("code_sha256", "hash", "First 16 digits of the hash over fieldkit's source."),
)
"""Columns that identify an attempt; the columns that its evidence fills follow."""

OTHERS: Final = Column("others", "text", "Robots in further roles of the procedure: ROLE=ROBOT, separated by spaces.")
"""The column is present only if a procedure has such roles."""

ALWAYS: Final = (*oracle_delays.LATENESS_COLUMNS, *link.COLUMNS, *oracle_delays.WINDOW_COLUMNS)
"""Columns that are measured in every trial, whatever its steps are."""

_KINDS_WITH_COLUMNS: Final = ("capture", "transfer", "ping")
"""Kinds of step whose columns are in every trial, in addition to `outage_columns.COLUMNS` of faults.

Columns of all other kinds are only in trials with such steps, so that a trial imports no kind that it does not use.
"""

Row = Mapping[str, Value]
"""Values of one attempt by column; missing values have no entry."""


@cache
def measures() -> tuple[Column, ...]:
    """Return the columns that evidence fills in every trial: columns of the testbed and of fieldkit's step kinds."""
    of_kinds = (column for kind in _KINDS_WITH_COLUMNS for column in step_types()[kind].columns)
    filled = dict.fromkeys((*ALWAYS, *of_kinds, *outage_columns.COLUMNS))
    return tuple(sorted(filled, key=lambda column: column.rank))


def trial_columns(additional: Iterable[Column] = ()) -> tuple[Column, ...]:
    """Return the columns of a trial.csv in order: columns of every trial, then others that its steps fill.

    Args:
        additional: Columns that not every trial has, as in the trial's plan.
    """
    everywhere = _common_columns()
    return (*everywhere.values(), *(column for column in additional if column.name not in everywhere))


@cache
def _common_columns() -> Mapping[str, Column]:
    return {column.name: column for column in (*IDENTITY, *measures())}


def of_step(step: Step) -> tuple[Column, ...]:
    """Return the columns that a step fills, with the prefix of the step."""
    return tuple(with_step_name(step.prefix, column) for column in step.output_columns())


def of_steps(steps: Iterable[Step]) -> tuple[Column, ...]:
    """Return the columns of steps that are not in every trial, in the order of the steps.

    These are columns of named steps, additional columns that a step declares, and columns of other packages' kinds.
    """
    return tuple(column for step in steps for column in of_step(step) if column.name not in _common_columns())


def of_robots(roles: Iterable[Role]) -> tuple[Column, ...]:
    """Return the columns of the reports of robots on their clocks and computers, and of the marks that they cause."""
    of_roles = (column for role in sort_roles(roles) for column in state_columns.declare_columns(role))
    return (*state_columns.MARK_COLUMNS, *of_roles)


def filled_by(steps: Iterable[Step]) -> tuple[Column, ...]:
    """Return the columns of a trial.csv that these steps, the testbed or the plan fill, in order."""
    step_columns = [column for step in steps for column in of_step(step)]
    names = {column.name for column in (*IDENTITY, *ALWAYS, *step_columns)}
    return tuple(column for column in trial_columns(step_columns) if column.name in names)


def column_conflict(column: Column, filled: Collection[str]) -> str | None:
    """Return the reason why a step cannot fill a column, or None if it can.

    Args:
        column: The column.
        filled: Names of the columns that other steps fill.
    """
    if declaration_error := column.declaration_error():
        return f"a column {column.name!r}: {declaration_error}"
    if _common_columns().get(column.name, column) != column:
        return f"a column {column.name!r} is one of fieldkit's; give the step a name, or rename the column"
    if column.name in filled:
        return f"a column {column.name!r} is filled by two steps; give the step a name"
    return None


@cache
def installed() -> tuple[Column, ...]:
    """Return the columns of every trial, of robots in fixed roles, and of step kinds of other packages.

    Raises:
        ConfigurationError: As for `step_types`, or a kind declares an invalid column, or one that exists already.
    """
    by_name = {**_common_columns(), **{column.name: column for column in of_robots(FIXED_ROLES)}}
    for kind, step in step_types().items():
        for column in step.columns:
            declaration_error = column.declaration_error()
            if declaration_error or by_name.setdefault(column.name, column) != column:
                raise ConfigurationError(
                    f"the kind of step {kind!r} declares a column {column.name!r}, "
                    + (f"but {declaration_error}" if declaration_error else "which exists already"),
                    where=f"{step.__module__}:{step.__name__}",
                    remedy="rename it there, or uninstall its package",
                )
    return tuple(by_name.values())
