"""`fieldkit verify TRIAL`: every file against the manifest."""

import argparse
from pathlib import Path

from fieldkit.cli.display import show_error
from fieldkit.cli.listing import Commands
from fieldkit.core.errors import EvidenceError
from fieldkit.core.units import format_count
from fieldkit.trial.store import verify


def add(commands: Commands) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "verify",
        help="compare a trial's files with its manifest",
        description="Compare every file of a trial with MANIFEST.sha256 (sha256sum -c reads it too).",
    )
    parser.add_argument("trial", type=Path, metavar="TRIAL", help="folder of a trial")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print what differs."""
    problems = verify(arguments.trial)
    for problem in problems:
        show_error(problem)
    print(
        f"{format_count(len(problems), 'file')} not as the manifest says"
        if problems
        else "every file is as its manifest says"
    )
    return EvidenceError.exit_code if problems else 0
