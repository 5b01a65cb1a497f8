"""`fieldkit compare A B`: compare two runs, for example a field trial and its simulation."""

import argparse
from pathlib import Path
from typing import Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.parser import Parser

PAIRED_BY: Final = "scenario,topology,distance_m,protocol"
"""Equal to `analysis.compare.PAIRED_BY`; a test compares them."""

_EPILOG: Final = """\
delta (Cliff's) shows how much the repeats of A and B overlap: among all pairs of a repeat of
A and a repeat of B, the share of pairs with the larger value in B minus the share with the
smaller value in B. +1 or -1: no overlap; 0: both shares are equal. `cliffs_delta` in CSV, JSON.

exit codes with --threshold: 0 if, in every condition in which A or B has the quantity,
the whole 95 % interval of B - A is within the threshold; 1 if it is not, or if A or
B has no such condition, no value of the quantity or no interval. Without --threshold: 0.

example: fieldkit compare field/ trials/ --threshold ip_loss=2% --threshold rtt_median_s=5ms"""


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit compare`."""
    parser.description = "Compare two runs by condition: the difference B - A with its 95 % interval, and a verdict."
    parser.epilog = _EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("a", type=Path, metavar="A", help=shared.PATH_HELP)
    parser.add_argument("b", type=Path, metavar="B", nargs="?", help="the second run (default: A, with --between)")
    parser.add_argument("more", type=Path, nargs="*", default=[], help=argparse.SUPPRESS)  # reported as an error
    parser.add_argument(
        "--between",
        default="",
        metavar="COLUMN=A,B",
        help="compare attempts with two values of a column, for example policy=sliding_window,scheduled of a sweep",
    )
    shared.add_where(parser)
    shared.add_cells(parser, PAIRED_BY)
    parser.add_argument(
        "--threshold",
        action="append",
        default=[],
        metavar="QUANTITY=VALUE",
        help="largest acceptable difference: ip_loss=2%% or rtt_median_s=5ms (a share: in percentage points); "
        "may be given more than once",
    )
    parser.add_argument("--force", action="store_true", help="also compare runs that are not comparable")
    shared.add_rebuild(parser)
    parser.add_choice("--format", shared.TABLES, default="table", help="output format (default: table)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the tables; return the exit code."""
    from fieldkit.cli import comparison_tables

    return comparison_tables.show(arguments)
