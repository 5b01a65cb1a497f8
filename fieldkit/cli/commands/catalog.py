"""`fieldkit robots`, `fieldkit procedures` and `fieldkit columns`: list all, or show one."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Final

from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.cli.display import table
from fieldkit.config import locations
from fieldkit.core.columns import DifferenceRow, EstimateRow, declared, plain_name
from fieldkit.core.errors import ConfigurationError, nearest

_SHOW: Final = "show"


def robots(arguments: argparse.Namespace) -> int:
    """List robot profiles, or show the one named."""
    from fieldkit.config.profiles import load_profile  # noqa: PLC0415 (pydantic and yaml)

    return _run("robots", lambda name: load_profile(name).summary, arguments.profile)


def procedures(arguments: argparse.Namespace) -> int:
    """List procedures, or show the one named."""
    from fieldkit.trial.procedure import load_procedure  # noqa: PLC0415 (as above)

    return _run("procedures", lambda name: load_procedure(name).summary, arguments.procedure)


def columns(arguments: argparse.Namespace) -> int:
    """List columns, those of a procedure, or show the one named."""
    if arguments.filled not in {None, _SHOW}:
        if arguments.column is not None:
            raise ConfigurationError(
                f"columns takes one procedure, and not {arguments.column!r} besides",
                remedy="fieldkit columns PROCEDURE, or: fieldkit columns show NAME",
            )
        return _columns_of(arguments.filled)
    if arguments.filled == _SHOW and arguments.column is None:
        raise ConfigurationError("columns show: no column is named", remedy="fieldkit columns lists them")
    return _columns(arguments.column)


def _columns_of(procedure: str) -> int:
    """List the columns that the steps of a procedure fill, of a name or in a file."""
    from fieldkit.trial.columns import filled_by  # noqa: PLC0415 (every kind of step, which no profile needs)
    from fieldkit.trial.procedure import load_procedure, read_procedure  # noqa: PLC0415 (pydantic and yaml)

    path = Path(procedure)
    found = read_procedure(path) if path.suffix == ".yaml" else load_procedure(procedure)
    filled = filled_by(placed.step for placed in found.walk())
    rows = [
        (column.name, column.unit, column.figure.kind if column.figure else "", column.meaning) for column in filled
    ]
    table(("column", "unit", "repeats make a", "meaning"), rows)
    return 0


def _columns(name: str | None) -> int:
    """List the columns of all files, or those of a name."""
    from fieldkit.trial.columns import installed  # noqa: PLC0415 (as above)

    trial = installed()
    files = {
        "trial.csv": trial,
        "summary.csv": (*(column for column in trial if column.name in DEFAULT_BY), *declared(EstimateRow)),
        "compare": declared(DifferenceRow),
    }
    known = {column.name for own in files.values() for column in own}
    wanted = name if name is None or name in known else plain_name(name)  # of a step that has a name
    rows = [
        (file, column.name, column.unit, column.meaning)
        for file, own in files.items()
        for column in own
        if wanted in {None, column.name}
    ]
    if not rows:
        raise ConfigurationError(
            f"there is no column {name!r}", remedy=nearest(name or "", known, "fieldkit columns lists them")
        )
    table(("file", "column", "unit", "meaning"), rows)
    return 0


def _run(kind: locations.Kind, summary: Callable[[str], str], name: str | None) -> int:
    """List all of `kind`, or show the file of the one named."""
    if name is None:
        rows = [(one, str(path), summary(one)) for one, path in locations.names(kind).items()]
        table(("name", "file", "summary"), rows)  # the last may be folded, which breaks a path
    else:
        summary(name)  # a file with an error is not shown as if it were good
        print(locations.find(kind, name).read_text(encoding="utf-8"), end="")
    return 0
