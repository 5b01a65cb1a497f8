"""What `fieldkit export` takes."""

from pathlib import Path

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit export` takes."""
    parser.description = "Write the rows of trials as one table, or what happened in one trial as a time line."
    shared.add_paths(parser)
    parser.add_choice(
        "--format",
        ("csv", "parquet", "mcap", "junit"),
        required=True,
        help="csv or parquet: the rows of all trials as one table; mcap: the time line of one trial, for "
        "Foxglove; junit: repeats and expectations, for CI servers",
    )
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="FILE", help="the file; none may be there")
    parser.set_defaults(run="export:run")
