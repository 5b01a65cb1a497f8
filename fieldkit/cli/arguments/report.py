"""What `fieldkit report` takes."""

from pathlib import Path

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit report` takes."""
    parser.description = "Make one HTML file of figures, tables and strips; it opens without a network."
    shared.add_paths(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("report.html"),
        metavar="FILE",
        help="the page (default report.html)",
    )
    parser.add_argument("--title", default="", help="its title (default: made of the procedures)")
    parser.add_argument(
        "--repeat",
        default="",
        metavar="NAME",
        help="whose time line is drawn: udp-07, or TRIAL/udp-07 (default: the median one where most is lost)",
    )
    parser.add_argument(
        "--quantity",
        action="append",
        default=[],
        metavar="NAME",
        help="column to draw besides those that are drawn anyway, may be given more than once",
    )
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="keep the figures there too: SVG, PDF and PNG")
    parser.set_defaults(run="report:run")
