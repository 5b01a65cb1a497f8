"""What `fieldkit trial` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit trial` takes."""
    parser.description = "Run a procedure: per protocol, so many repeats of record, capture, transfer and ping."
    parser.epilog = "example: fieldkit trial los 30ft --repeats 3 --record 2s"
    parser.add_argument("procedure", metavar="PROCEDURE", help="name of a procedure, see `fieldkit procedures`")
    parser.add_argument("distances", metavar="DISTANCE", nargs="+", help="with a unit, for example 30ft or 9.1m")
    shared.add_site(parser)
    shared.add_changes(parser)
    parser.add_argument(
        "--seed", type=shared.natural, metavar="N", default=1, help="seed of everything random (default: 1)"
    )
    parser.add_argument(
        "--notes",
        type=shared.free_text,
        metavar="TEXT",
        default="",
        help="kept with the trial: weather, place, people",
    )
    shared.add_out(parser, "trial folders go")
    parser.add_argument("--dry-run", action="store_true", help="print every remote command per robot, touch nothing")
    shared.add_json(parser)
    shared.add_operator(parser)
    shared.add_junit(parser)
    parser.set_defaults(run="trial:run")
