"""What `fieldkit procedures` takes."""

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit procedures` takes."""
    parser.description = "List procedures, or show one."
    shared.add_show(parser, "procedure", "procedure")
    parser.set_defaults(run="catalog:procedures")
