"""`fieldkit procedures`: list procedures, or show one."""

import argparse

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.listing import list_or_show
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit procedures`."""
    parser.description = (
        "List procedures with their files, or check one and print its file. The folder procedures/ of the current "
        "folder comes before the shipped ones: a file of the same name replaces the shipped one."
    )
    shared.add_show(parser, "procedure", "procedure")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List procedures, or show the one named."""
    from fieldkit.trial.procedure import load_procedure

    return list_or_show("procedures", lambda name: load_procedure(name).summary, arguments.procedure)
