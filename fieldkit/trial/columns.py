"""The columns of trial.csv. Some columns identify an attempt; steps and the testbed declare the others."""

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
    0,  # the rank: these columns are the first columns of the table
    ("schema_version", "count", "Version of the columns in the version of fieldkit that measured the row."),
    ("trial", "text", "Name of the trial's folder."),
    ("procedure", "text", "Name of the procedure."),
    ("scenario", "text", "los (line of sight) or nlos (no line of sight)."),
    ("topology", "text", "master (packets pass a relay) or masterless."),
    (
        "backend",
        "text",
        "Backend that provided the robots; for a co-simulation, physics, network and sync policy follow in brackets.",
    ),
    ("distance_m", "m", "Planned distance."),
    ("distance", "text", "Planned distance as written by the operator."),
    ("protocol", "text", "Transport protocol: tcp or udp."),
    ("repeat", "count", "Number of the repeat of this protocol, from 1."),
    (
        "attempt",
        "count",
        "Number of the attempt, from 1; above 1 after a void attempt. The last allowed attempt is valid or failed.",
    ),
    ("status", "text", "valid, void (not valid, so the repeat is tried again) or failed (no valid attempt)."),
    ("reason", "text", "Reason why the attempt is not valid; empty if it is valid."),
    ("started_utc_ns", "ns", "Start by the laptop's clock, nanoseconds since 1970 UTC."),
    ("seed", "count", "The trial's seed."),
    ("sender", "text", "Robot in the role sender."),
    ("receiver", "text", "Robot in the role receiver."),
    ("relay", "text", "Robot whose access point relays the packets; empty if masterless."),
    ("profiles_sha256", "hash", "First 16 digits of the hash of the robots' profiles and roles."),
    ("procedure_sha256", "hash", "First 16 digits of the hash of the procedure: its file and --record."),
    ("code_sha256", "hash", "First 16 digits of the hash of fieldkit's source."),
)
"""Columns that identify an attempt. The columns of measured values follow them."""

OTHERS: Final = Column("others", "text", "Robots in further roles of the procedure: ROLE=ROBOT, separated by spaces.")
"""Column that is in a table only if the procedure has further roles."""

ALWAYS: Final = (*oracle_delays.LATENESS_COLUMNS, *link.COLUMNS, *oracle_delays.WINDOW_COLUMNS)
"""Columns that are measured in every trial, independent of its steps."""

_KINDS_WITH_COLUMNS: Final = ("capture", "transfer", "ping")
"""Kinds of step whose columns are in every trial, in addition to the columns of faults (`outage_columns.COLUMNS`).

Columns of other kinds are only in trials with such steps, so that a trial does not import kinds that it does not use.
"""

Row = Mapping[str, Value]
"""Values of one attempt by column name; missing values have no entry."""


@cache
def measured_columns() -> tuple[Column, ...]:
    """Return the columns of measured values in every trial: of the testbed, faults and `_KINDS_WITH_COLUMNS`."""
    kind_columns = (column for kind in _KINDS_WITH_COLUMNS for column in step_types()[kind].columns)
    unique_columns = dict.fromkeys((*ALWAYS, *kind_columns, *outage_columns.COLUMNS))
    return tuple(sorted(unique_columns, key=lambda column: column.rank))


def trial_columns(additional: Iterable[Column] = ()) -> tuple[Column, ...]:
    """Return the columns of a trial.csv in order: the columns of every trial, then additional ones.

    Args:
        additional: Columns that not every trial has, as in the trial's plan.
    """
    common = _common_columns()
    return (*common.values(), *(column for column in additional if column.name not in common))


@cache
def _common_columns() -> Mapping[str, Column]:
    return {column.name: column for column in (*IDENTITY, *measured_columns())}


def columns_of_step(step: Step) -> tuple[Column, ...]:
    """Return the columns of a step, with the prefix of the step."""
    return tuple(with_step_name(step.prefix, column) for column in step.output_columns())


def additional_columns(steps: Iterable[Step]) -> tuple[Column, ...]:
    """Return the columns of these steps, without the columns that every trial has, in the order of the steps.

    They are columns of named steps, further columns that a step declares, and columns of kinds of other packages.
    """
    return tuple(column for step in steps for column in columns_of_step(step) if column.name not in _common_columns())


def robot_columns(roles: Iterable[Role]) -> tuple[Column, ...]:
    """Return the columns of the robots' states (clocks, computers, radios) and of marks.

    A mark is a condition of a robot that can explain a difference between repeats, for example a wrong clock.
    """
    role_columns = (column for role in sort_roles(roles) for column in state_columns.declare_columns(role))
    return (*state_columns.MARK_COLUMNS, *role_columns)


def filled_columns(steps: Iterable[Step]) -> tuple[Column, ...]:
    """Return the columns of a trial.csv in which these steps, the testbed or the plan enter values, in order."""
    step_columns = [column for step in steps for column in columns_of_step(step)]
    names = {column.name for column in (*IDENTITY, *ALWAYS, *step_columns)}
    return tuple(column for column in trial_columns(step_columns) if column.name in names)


def column_conflict(column: Column, names: Collection[str]) -> str | None:
    """Return the reason why a step cannot have a column, or None if it can.

    Args:
        column: The column.
        names: Names of the columns of other steps.
    """
    if declaration_error := column.declaration_error():
        return f"a column {column.name!r}: {declaration_error}"
    if _common_columns().get(column.name, column) != column:
        return f"fieldkit has another column {column.name!r}; give the step a name, or rename the column"
    if column.name in names:
        return f"two steps have a column {column.name!r}; give the step a name"
    return None


@cache
def installed_columns() -> tuple[Column, ...]:
    """Return the columns of every trial, of robots in fixed roles, and of all installed kinds of step.

    Raises:
        ConfigurationError: For the same reasons as `step_types`, or because a kind declares an invalid column or a
            column that exists already.
    """
    columns_by_name = {**_common_columns(), **{column.name: column for column in robot_columns(FIXED_ROLES)}}
    for kind, step in step_types().items():
        for column in step.columns:
            declaration_error = column.declaration_error()
            # `setdefault` returns the column that has this name already, if there is one.
            if declaration_error or columns_by_name.setdefault(column.name, column) != column:
                raise ConfigurationError(
                    f"the kind of step {kind!r} declares a column {column.name!r}, "
                    + (f"but {declaration_error}" if declaration_error else "which exists already"),
                    where=f"{step.__module__}:{step.__name__}",
                    remedy=f"{'correct' if declaration_error else 'rename'} it there, or uninstall its package",
                )
    return tuple(columns_by_name.values())
