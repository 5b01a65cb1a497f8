"""The columns of trial.csv: what tells an attempt from others, then what steps and the testbed declare."""

from collections.abc import Collection, Iterable, Mapping
from functools import cache
from typing import Final

from fieldkit.core import columns
from fieldkit.core.columns import Column, Value, named
from fieldkit.core.errors import ConfigurationError
from fieldkit.measure.evidence import lateness, link
from fieldkit.steps import kinds
from fieldkit.steps.base import Step, step_types

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

OTHERS: Final = Column("others", "text", "Robots in roles of the procedure's own: ROLE=ROBOT, a blank between them.")
"""Only where a procedure has such roles."""

ALWAYS: Final = (*lateness.COLUMNS, *link.COLUMNS)
"""What is measured whatever the steps are."""

Row = Mapping[str, Value]
"""Values of one attempt by column; a column that is missing is not there."""


@cache
def measures() -> tuple[Column, ...]:
    """Return every column that evidence fills in every trial: the testbed's own, and fieldkit's own kinds'."""
    own = kinds.own()
    of_kinds = (column for kind, step in step_types().items() if kind in own for column in step.columns)
    filled = dict.fromkeys((*ALWAYS, *of_kinds))
    return tuple(sorted(filled, key=lambda column: column.rank))


def trial_columns(beyond: Iterable[Column] = ()) -> tuple[Column, ...]:
    """Return the columns of a trial.csv in order: what is in every one, then what its steps measure besides.

    Args:
        beyond: Columns of the trial's own, as its plan has them.
    """
    everywhere = _everywhere()
    return (*everywhere.values(), *(column for column in beyond if column.name not in everywhere))


@cache
def _everywhere() -> Mapping[str, Column]:
    return {column.name: column for column in (*IDENTITY, *measures())}


def of_step(step: Step) -> tuple[Column, ...]:
    """Return the columns that a step fills, as a row has them."""
    return tuple(named(step.prefix, column) for column in step.output_columns())


def of_steps(steps: Iterable[Step]) -> tuple[Column, ...]:
    """Return the columns of steps that are not in every trial, in the order of the steps.

    Those of steps that have a name, of steps that declare columns of their own, and of other packages' kinds.
    """
    return tuple(column for step in steps for column in of_step(step) if column.name not in _everywhere())


def filled_by(steps: Iterable[Step]) -> tuple[Column, ...]:
    """Return the columns of a trial.csv that are not always empty where these steps run, in order."""
    own = [column for step in steps for column in of_step(step)]
    names = {column.name for column in (*IDENTITY, *ALWAYS, *own)}
    return tuple(column for column in trial_columns(own) if column.name in names)


def clash(column: Column, filled: Collection[str]) -> str | None:
    """Return why a step cannot fill a column, None where it can.

    Args:
        column: Which.
        filled: Names of the columns that other steps fill.
    """
    if flaw := column.flaw():
        return f"a column {column.name!r}: {flaw}"
    if _everywhere().get(column.name, column) != column:
        return f"a column {column.name!r} is fieldkit's own already; give the step a name, or the column another one"
    if column.name in filled:
        return f"a column {column.name!r} comes twice, and a row has room for one; give the step a name"
    return None


@cache
def installed() -> tuple[Column, ...]:
    """Return the columns of every trial, and those that other packages' kinds of step declare.

    Raises:
        ConfigurationError: As `step_types`, or a kind declares an invalid column, or one whose name is taken.
    """
    found = dict(_everywhere())
    for kind, step in step_types().items():
        for column in step.columns:
            flaw = column.flaw()
            if flaw or found.setdefault(column.name, column) != column:
                raise ConfigurationError(
                    f"the kind of step {kind!r} declares a column {column.name!r}, "
                    + (f"but {flaw}" if flaw else "which is another's already"),
                    where=f"{step.__module__}:{step.__name__}",
                    remedy="rename it there, or uninstall its package",
                )
    return tuple(found.values())
