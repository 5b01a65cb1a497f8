"""What `fieldkit resume` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit resume` takes."""
    parser.description = "Go on with a trial that was interrupted, killed or cut off: nothing that is done is redone."
    shared.add_trial(parser, "folder of the trial")
    shared.add_site(parser)
    shared.add_operator(parser)
    shared.add_json(parser)
    shared.add_junit(parser)
    parser.set_defaults(run="resume:run")
