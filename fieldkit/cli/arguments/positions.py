"""What `fieldkit positions` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit positions` takes."""
    parser.description = (
        "Keep files that tell where robots were with a trial, and fill the distance and speed columns "
        "from them; without any, list who tells it in each repeat."
    )
    parser.epilog = "example: fieldkit positions trials/... receiver=walk.gpx sender=48.13740,11.57550 --offset 0.3s"
    parser.takes_lengths = True
    shared.add_trial(parser)
    parser.add_argument(
        "told",
        metavar="ROLE=FILE",
        nargs="*",
        help="GPX or CSV of the robot in that role, or where it stood: LAT,LON[,ALT], or X,Y[,Z] with units",
    )
    parser.add_argument(
        "--offset", metavar="TIME", default="0s", help="add it to the times of the files: 0.3s, -2s (default: 0s)"
    )
    parser.add_argument(
        "--gap", metavar="TIME", default="3s", help="nobody knows where a robot was in longer gaps (default: 3s)"
    )
    parser.add_argument("--heights", action="store_true", help="let heights over the ellipsoid count, too")
    parser.add_argument("--clear", action="store_true", help="forget what was given")
    parser.set_defaults(run="positions:run")
