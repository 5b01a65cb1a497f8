"""What `fieldkit rebuild` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit rebuild` takes."""
    parser.description = "Make trial.csv and summary.csv again from plan, journal and raw evidence: the same bytes."
    shared.add_trial(parser)
    parser.set_defaults(run="rebuild:run")
