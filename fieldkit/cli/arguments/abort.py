"""What `fieldkit abort` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit abort` takes."""
    parser.description = (
        "End every job that fieldkit started on any robot of the site file, whoever started it, and "
        "break the robots' locks. The trial that runs there stops, and says who aborted it."
    )
    shared.add_site(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask")
    parser.set_defaults(run="abort:run")
