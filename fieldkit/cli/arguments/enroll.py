"""What `fieldkit enroll` takes."""

from pathlib import Path

from fieldkit.cli.parser import Parser
from fieldkit.config.locations import SITE_FILE


def add(parser: Parser) -> None:
    """Declare what `fieldkit enroll` takes."""
    parser.description = "Show the host key that a robot offers, and pin it in the site file once you compared it."
    parser.add_argument("robot", metavar="ROBOT", help="name of a robot in the site file")
    parser.add_argument(
        "--site", type=Path, metavar="FILE", default=Path(SITE_FILE), help=f"site file (default: {SITE_FILE})"
    )
    parser.add_argument("--yes", action="store_true", help="do not ask: the key was compared, or need not be")
    parser.add_argument("--replace", action="store_true", help="pin it also in place of another one")
    parser.set_defaults(run="enroll:run")
