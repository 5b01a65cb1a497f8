"""`fieldkit columns`: what every CSV column means."""

import argparse
import difflib
from typing import Any, Final

from fieldkit.analysis.summary import CellRow
from fieldkit.cli.display import table
from fieldkit.cli.listing import Commands, add_show
from fieldkit.columns import RepeatRow, declared
from fieldkit.errors import ConfigurationError

_FILES: Final[dict[str, type[Any]]] = {"trial.csv": RepeatRow, "summary.csv": CellRow}


def add(commands: Commands) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "columns", help="list the CSV columns, or show NAME", description="What every column of the CSVs means."
    )
    add_show(parser, "column")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the columns."""
    rows = [
        (file, column.name, column.unit, column.meaning)
        for file, row in _FILES.items()
        for column in declared(row)
        if arguments.name in {None, column.name}
    ]
    if not rows:
        known = {column.name for row in _FILES.values() for column in declared(row)}
        near = difflib.get_close_matches(arguments.name, known, n=1)
        raise ConfigurationError(
            f"there is no column {arguments.name!r}",
            remedy=f"did you mean {near[0]!r}?" if near else "fieldkit columns lists them",
        )
    table(("file", "column", "unit", "meaning"), rows)
    return 0
