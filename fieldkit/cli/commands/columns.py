"""`fieldkit columns`: list columns, or show one."""

import argparse
from pathlib import Path
from typing import Final

from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.cli.display import table
from fieldkit.cli.parser import Parser
from fieldkit.core.columns import DifferenceRow, EstimateRow, declared, plain_name
from fieldkit.core.errors import ConfigurationError, did_you_mean


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit columns`."""
    parser.usage = "%(prog)s [-h] [PROCEDURE | show NAME]"
    parser.description = (
        "Explain the columns of the CSV files: all, those that the steps of a procedure fill, or one."
    )
    parser.add_argument("filled", metavar="PROCEDURE", nargs="?", help="a procedure, or its file, or the word show")
    parser.add_argument("column", metavar="NAME", nargs="?", help="after the word show: name of a column")
    parser.set_defaults(run=run)


_SHOW: Final = "show"


def run(arguments: argparse.Namespace) -> int:
    """List all columns or those of a procedure, or show one."""
    if arguments.filled not in {None, _SHOW}:
        if arguments.column is not None:
            raise ConfigurationError(
                f"columns takes one procedure; {arguments.column!r} is one argument too many",
                remedy="fieldkit columns PROCEDURE, or: fieldkit columns show NAME",
            )
        return _columns_of(arguments.filled)
    if arguments.filled == _SHOW and arguments.column is None:
        raise ConfigurationError("columns show: no column is given", remedy="fieldkit columns lists them")
    return _columns(arguments.column)


def _columns_of(procedure: str) -> int:
    """List the columns that the steps of a procedure fill, given by its name or its file."""
    from fieldkit.trial.columns import filled_by
    from fieldkit.trial.procedure import load_procedure, read_procedure

    path = Path(procedure)
    loaded = read_procedure(path) if path.suffix == ".yaml" else load_procedure(procedure)
    filled = filled_by(placed.step for placed in loaded.walk())
    rows = [
        (column.name, column.unit, column.figure.kind if column.figure else "", column.meaning) for column in filled
    ]
    table(("column", "unit", "repeats make a", "meaning"), rows)
    return 0


def _columns(name: str | None) -> int:
    """List the columns of all files, or those called `name`."""
    from fieldkit.trial.columns import installed

    trial = installed()
    files = {
        "trial.csv": trial,
        "summary.csv": (*(column for column in trial if column.name in DEFAULT_BY), *declared(EstimateRow)),
        "compare": declared(DifferenceRow),
    }
    known = {column.name for columns in files.values() for column in columns}
    wanted = (
        name if name is None or name in known else plain_name(name)
    )  # a named step adds its name to the column's name
    rows = [
        (file, column.name, column.unit, column.meaning)
        for file, columns in files.items()
        for column in columns
        if wanted in {None, column.name}
    ]
    if not rows:
        raise ConfigurationError(
            f"there is no column {name!r}", remedy=did_you_mean(name or "", known, "fieldkit columns lists them")
        )
    table(("file", "column", "unit", "meaning"), rows)
    return 0
