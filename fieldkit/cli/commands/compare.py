"""`fieldkit compare A B`: field against simulation, or two runs."""

import argparse
from pathlib import Path
from typing import Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.parser import Parser

PAIRED_BY: Final = "scenario,topology,distance_m,protocol"
"""`analysis.compare.PAIRED_BY`, which a test compares."""

_EPILOG: Final = """\
delta (Cliff's) says how much the repeats of both overlap: of all pairs of one of A and
one of B, the share in which B is the larger less that in which it is the smaller. +1 or
-1: no overlap, however close; 0: each is the larger as often. `cliffs_delta` in CSV, JSON.

exit codes with --threshold: 0 if, in every cell in which A or B has the quantity,
the whole 95 % interval of B - A is within the threshold; 1 if it is not, or if one
of the two has no such cell, not the quantity, or no interval. Without: 0.

example: fieldkit compare field/ trials/ --threshold ip_loss=2% --threshold rtt_median_s=5ms"""


def add(parser: Parser) -> None:
    """Declare what `fieldkit compare` takes."""
    parser.description = "Compare two runs cell by cell: the difference B - A with its 95 % interval, and a verdict."
    parser.epilog = _EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("a", type=Path, metavar="A", help=shared.PATH_HELP)
    parser.add_argument("b", type=Path, metavar="B", help="the same")
    parser.add_argument("more", type=Path, nargs="*", help=argparse.SUPPRESS)  # a glob finds more than two
    shared.add_cells(parser, PAIRED_BY)
    parser.add_argument(
        "--threshold",
        action="append",
        default=[],
        metavar="QUANTITY=VALUE",
        help="how far apart the two may be, ip_loss=2%% or rtt_median_s=5ms (a share: in percentage points); "
        "may be given more than once",
    )
    parser.add_argument("--force", action="store_true", help="compare also runs that are not comparable")
    shared.add_rebuild(parser)
    parser.add_choice("--format", shared.TABLES, default="table", help="how it is printed (default table)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the tables; return the exit code."""
    from fieldkit.cli import comparison_tables

    return comparison_tables.show(arguments)
