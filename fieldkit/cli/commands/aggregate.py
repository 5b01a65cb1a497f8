"""`fieldkit aggregate PATH...`: many trials as one table."""

import argparse

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit aggregate`."""
    parser.description = "Aggregate the repeats of any number of trials, condition by condition, with 95 % intervals."
    parser.epilog = "example: fieldkit aggregate trials --by distance,protocol --quantity ip_loss"
    shared.add_paths(parser)
    shared.add_workers(parser)
    shared.add_where(parser)
    shared.add_cells(parser)
    parser.add_argument(
        "--quantity",
        action="append",
        default=[],
        metavar="NAME",
        help="column to show; may be given more than once (default: the main ones for table, RTT and losses for "
        "latex, else all)",
    )
    shared.add_all(parser)
    parser.add_argument(
        "--width",
        action="append",
        default=[],
        metavar="WIDTH",
        help="report how many more repeats are needed for an interval of the value +-WIDTH, in any unit: 2%% for "
        "shares, 1ms for times, 100kbit/s for rates, 2dB for dBm; may be given more than once; implies --all",
    )
    parser.add_choice(
        "--format",
        (*shared.TABLES, "latex"),
        default="table",
        help="csv has the form of summary.csv, and the column more_wanted with --width (default: table)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the tables; return the exit code."""
    from fieldkit.cli import aggregation_tables

    return aggregation_tables.show(arguments)
