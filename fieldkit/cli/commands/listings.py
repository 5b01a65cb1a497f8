"""`fieldkit robots`, `fieldkit procedures` and `fieldkit columns`: list items, or show one."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import print_table
from fieldkit.cli.parser import Parser
from fieldkit.config import locations
from fieldkit.core.columns import plain_name
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.result_rows import DifferenceRow, EstimateRow, declared_columns
from fieldkit.core.text import print_text


def add_robots(parser: Parser) -> None:
    """Declare the arguments of `fieldkit robots`."""
    parser.description = (
        "List robot profiles with their files, or check one and print its file. The folder robots/ of the current "
        "folder comes before the shipped ones: a file of the same name replaces the shipped one."
    )
    shared.add_show(parser, "profile", "robot profile")
    parser.set_defaults(run=run_robots)


def run_robots(arguments: argparse.Namespace) -> int:
    """List robot profiles, or show one."""
    from fieldkit.config.profiles import load_profile

    return _list_or_show("robots", lambda name: load_profile(name).summary, arguments.profile)


def add_procedures(parser: Parser) -> None:
    """Declare the arguments of `fieldkit procedures`."""
    parser.description = (
        "List procedures with their files, or check one and print its file. The folder procedures/ of the current "
        "folder comes before the shipped ones: a file of the same name replaces the shipped one."
    )
    shared.add_show(parser, "procedure", "procedure")
    parser.set_defaults(run=run_procedures)


def run_procedures(arguments: argparse.Namespace) -> int:
    """List procedures, or show one."""
    from fieldkit.trial.procedure import load_procedure

    return _list_or_show("procedures", lambda name: load_procedure(name).summary, arguments.procedure)


def _list_or_show(kind: locations.Kind, summary: Callable[[str], str], name: str | None) -> int:
    """List all files of `kind`, or show the file called `name`."""
    if name is None:
        rows = [(item, str(path), summary(item)) for item, path in locations.names(kind).items()]
        print_table(("name", "file", "summary"), rows)  # only the last column is folded, so paths stay on one line
    else:
        summary(name)  # raises if the file has an error
        print_text(locations.find(kind, name).read_text(encoding="utf-8"), end="")
    return 0


def add_columns(parser: Parser) -> None:
    """Declare the arguments of `fieldkit columns`."""
    parser.usage = "%(prog)s [-h] [PROCEDURE | show NAME]"
    parser.description = (
        "Explain the columns of the CSV files: all, those that a trial with a procedure fills, or one."
    )
    parser.add_argument(
        "procedure_or_show",
        metavar="PROCEDURE",
        nargs="?",
        help="a procedure, or its file, or the word show",
    )
    parser.add_argument("column", metavar="NAME", nargs="?", help="after the word show: name of a column")
    parser.set_defaults(run=run_columns)


_SHOW: Final = "show"


def run_columns(arguments: argparse.Namespace) -> int:
    """List all columns or the columns of a procedure, or show one."""
    if arguments.procedure_or_show not in {None, _SHOW}:
        if arguments.column is not None:
            raise ConfigurationError(
                f"columns takes one procedure; {arguments.column!r} is one argument too many",
                remedy="fieldkit columns PROCEDURE, or: fieldkit columns show NAME",
            )
        return _columns_of(arguments.procedure_or_show)
    if arguments.procedure_or_show == _SHOW and arguments.column is None:
        raise ConfigurationError("columns show: no column is given", remedy="fieldkit columns lists them")
    return _columns(arguments.column)


def _columns_of(procedure: str) -> int:
    """List the columns that a trial with a procedure fills. The procedure is given by its name or its file."""
    from fieldkit.trial.columns import filled_columns, installed_columns
    from fieldkit.trial.procedure import load_procedure, read_procedure

    path = Path(procedure)
    if procedure not in locations.names("procedures") and any(
        column.name == procedure for column in installed_columns()
    ):
        raise ConfigurationError(
            f"{procedure} is a column, not a procedure", remedy=f"fieldkit columns show {procedure}"
        )
    parsed_procedure = read_procedure(path) if path.suffix == ".yaml" else load_procedure(procedure)
    shown_columns = filled_columns(placed.step for placed in parsed_procedure.walk())
    rows = [
        (column.name, column.unit, column.figure.kind if column.figure else "", column.meaning)
        for column in shown_columns
    ]
    print_table(("column", "unit", "aggregated as", "meaning"), rows)
    return 0


def _columns(name: str | None) -> int:
    """List the columns of all files, or the columns called `name`."""
    from fieldkit.analysis.quantities import DEFAULT_BY
    from fieldkit.trial.columns import installed_columns

    trial = installed_columns()
    columns_by_file = {
        "trial.csv": trial,
        "summary.csv": (*(column for column in trial if column.name in DEFAULT_BY), *declared_columns(EstimateRow)),
        "compare": declared_columns(DifferenceRow),
    }
    column_names = {column.name for columns in columns_by_file.values() for column in columns}
    # A step with a name adds its name to the names of its columns.
    selected_name = name if name is None or name in column_names else plain_name(name)
    rows = [
        (file, column.name, column.unit, column.meaning)
        for file, columns in columns_by_file.items()
        for column in columns
        if selected_name in {None, column.name}
    ]
    if not rows:
        raise ConfigurationError(
            f"there is no column {name!r}",
            remedy=did_you_mean(name or "", column_names, "fieldkit columns lists them"),
        )
    print_table(("file", "column", "unit", "meaning"), rows)
    return 0
