"""What `fieldkit aggregate` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit aggregate` takes."""
    parser.description = (
        "Put the repeats of any number of trials together, condition by condition, with 95 % intervals."
    )
    parser.epilog = "example: fieldkit aggregate trials --by distance,protocol --quantity ip_loss"
    shared.add_paths(parser)
    shared.add_cells(parser)
    parser.add_argument(
        "--quantity",
        action="append",
        default=[],
        metavar="NAME",
        help="column to show, may be given more than once (default: all; latex: RTT and losses)",
    )
    parser.add_argument(
        "--width",
        action="append",
        default=[],
        metavar="WIDTH",
        help="tell how many more repeats make an interval +-WIDTH: 2%% for shares, 1ms, 100kbit/s; may be repeated",
    )
    parser.add_choice("--format", (*shared.TABLES, "latex"), default="table", help="default: table")
    parser.set_defaults(run="aggregate:run")
