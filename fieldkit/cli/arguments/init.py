"""What `fieldkit init` takes."""

from pathlib import Path

from fieldkit.cli.parser import Parser
from fieldkit.config.locations import SITE_FILE


def add(parser: Parser) -> None:
    """Declare what `fieldkit init` takes."""
    parser.description = "Write a site file in which every line is explained; a file that exists is not overwritten."
    parser.add_argument(
        "--out", type=Path, metavar="FILE", default=Path(SITE_FILE), help=f"the file (default: {SITE_FILE})"
    )
    parser.set_defaults(run="init:run")
