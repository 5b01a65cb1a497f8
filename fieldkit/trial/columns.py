"""The columns of trial.csv: what tells an attempt from others, then what steps and the testbed declare."""

from collections.abc import Mapping
from functools import cache
from typing import Final

from fieldkit.core import columns
from fieldkit.core.columns import Column, Value
from fieldkit.core.errors import ConfigurationError
from fieldkit.measure.evidence import lateness
from fieldkit.steps.base import known

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
    """Return every column that evidence fills: the testbed's own, and those of every kind of step.

    Raises:
        ConfigurationError: As `known`, or a kind declares a column whose name stands for another.
    """
    declared = {column.name: column for column in (*IDENTITY, *lateness.COLUMNS)}
    for kind, step in known().items():
        for column in step.columns:
            if declared.setdefault(column.name, column) != column:
                raise ConfigurationError(
                    f"the kind of step {kind!r} declares a column {column.name!r}, which is another's already",
                    where=f"{step.__module__}:{step.__name__}",
                    remedy="rename it there, or uninstall its package",
                )
    filled = (column for column in declared.values() if column not in IDENTITY)
    return tuple(sorted(filled, key=lambda column: column.rank))


@cache
def trial_columns() -> tuple[Column, ...]:
    """Return the columns of trial.csv in order."""
    return (*IDENTITY, *measures())
