"""`fieldkit docs`: open the installed documentation."""

import argparse
import webbrowser

from fieldkit.cli.display import print_table
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.text import print_text


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit docs`."""
    parser.description = (
        "Open the documentation of this version in a browser. It is installed with fieldkit and needs no network. "
        "TOPIC is the name of a page, such as field, steps or errors, or of a command, such as trial."
    )
    parser.epilog = "example: fieldkit docs errors"
    parser.add_argument(
        "topic", metavar="TOPIC", nargs="?", default="index", help="a page or a command (default: index)"
    )
    output_options = parser.add_mutually_exclusive_group()
    output_options.add_argument(
        "--path", action="store_true", help="print the path of the page instead of opening it"
    )
    output_options.add_argument("--list", action="store_true", help="list all topics with their pages")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Open a page, print its path, or list all pages."""
    from fieldkit.config import documentation

    if arguments.list:
        print_table(("topic", "page"), [(topic, str(path)) for topic, path in documentation.topics().items()])
        return 0
    page = documentation.find(arguments.topic)
    if arguments.path:
        print_text(str(page.path))
    elif not webbrowser.open(page.uri):
        raise ConfigurationError(
            "this machine has no browser", remedy=f"copy its folder to a machine with a browser: {page.path}"
        )
    return 0
