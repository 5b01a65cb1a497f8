"""`fieldkit columns`: what every CSV column means."""

import argparse

from fieldkit.analysis.cells import DEFAULT_BY
from fieldkit.cli.display import table
from fieldkit.cli.listing import Commands, add_show
from fieldkit.core.columns import Column, DifferenceRow, EstimateRow, declared
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.trial.rows import trial_columns


def _files() -> dict[str, tuple[Column, ...]]:
    trial = trial_columns()
    return {
        "trial.csv": trial,
        "summary.csv": (*(one for one in trial if one.name in DEFAULT_BY), *declared(EstimateRow)),
        "compare": declared(DifferenceRow),
    }


def add(commands: Commands) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "columns", help="list the CSV columns, or show NAME", description="What every column of the CSVs means."
    )
    add_show(parser, "column")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the columns."""
    files = _files()
    rows = [
        (file, column.name, column.unit, column.meaning)
        for file, columns in files.items()
        for column in columns
        if arguments.name in {None, column.name}
    ]
    if not rows:
        known = {column.name for columns in files.values() for column in columns}
        raise ConfigurationError(
            f"there is no column {arguments.name!r}",
            remedy=nearest(arguments.name, known, "fieldkit columns lists them"),
        )
    table(("file", "column", "unit", "meaning"), rows)
    return 0
