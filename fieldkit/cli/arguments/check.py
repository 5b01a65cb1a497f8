"""What `fieldkit check` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit check` takes."""
    parser.description = "Look at everything that a trial needs of the robots and of this machine; change nothing."
    parser.epilog = "example: fieldkit check los --topology masterless"
    parser.add_argument("procedure", metavar="PROCEDURE", nargs="?", default="los", help="default: los")
    shared.add_site(parser)
    shared.add_changes(parser)
    shared.add_json(parser)
    parser.set_defaults(run="check:run")
