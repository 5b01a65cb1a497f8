"""What `fieldkit robots` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit robots` takes."""
    parser.description = "List robots, or show one."
    shared.add_show(parser, "profile", "robot profile")
    parser.set_defaults(run="catalog:robots")
