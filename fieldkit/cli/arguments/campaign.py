"""What `fieldkit campaign` takes."""

from pathlib import Path

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare what `fieldkit campaign` takes."""
    parser.description = "Run the trials of a campaign file in a shuffled order. The same command goes on later."
    parser.epilog = "example: fieldkit campaign lawn.yaml --dry-run"
    parser.add_argument("file", type=Path, metavar="FILE", help="campaign file, see docs/campaign.md")
    shared.add_site(parser)
    shared.add_out(parser, "the campaign's folder goes")
    parser.add_argument("--dry-run", action="store_true", help="print order, way and time; touch nothing")
    shared.add_json(parser)
    shared.add_operator(parser)
    shared.add_junit(parser)
    parser.set_defaults(run="campaign:run")
