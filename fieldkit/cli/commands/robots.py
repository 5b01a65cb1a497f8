"""`fieldkit robots`: list robot profiles, or show one."""

import argparse

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.listing import list_or_show
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit robots`."""
    parser.description = (
        "List robot profiles with their files, or check one and print its file. The folder robots/ of the current "
        "folder comes before the shipped ones: a file of the same name replaces the shipped one."
    )
    shared.add_show(parser, "profile", "robot profile")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List robot profiles, or show one."""
    from fieldkit.config.profiles import load_profile

    return list_or_show("robots", lambda name: load_profile(name).summary, arguments.profile)
