"""What `fieldkit verify` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit verify` takes."""
    parser.description = "Compare every file of a trial with MANIFEST.sha256 (sha256sum -c reads it too)."
    shared.add_trial(parser)
    parser.set_defaults(run="verify:run")
