"""`fieldkit verify TRIAL`: compare every file with the manifest."""

import argparse

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_error
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import print_text
from fieldkit.core.units import format_count


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit verify`."""
    parser.description = (
        "Compare every file of a trial with MANIFEST.sha256, and list files that were changed, are missing, are not "
        "in it, or are not regular files."
    )
    shared.add_trial(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the differences."""
    from fieldkit.trial.stored.verification import verify

    problems = verify(arguments.trial)
    for problem in problems:
        show_error(problem)
    print_text(
        f"{format_count(len(problems), 'file')} different from the manifest"
        if problems
        else "every file matches the manifest"
    )
    return EvidenceError.exit_code if problems else 0
