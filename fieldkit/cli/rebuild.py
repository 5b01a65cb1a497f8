"""`fieldkit rebuild TRIAL`: the tables again, from raw evidence."""

import argparse
from pathlib import Path

from fieldkit.cli.listing import Commands
from fieldkit.cli.results import summary_table
from fieldkit.trial.rebuild import rebuild


def add(commands: Commands) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "rebuild",
        help="make trial.csv and summary.csv again from raw evidence",
        description="Make trial.csv and summary.csv again from plan, journal and raw evidence: the same bytes.",
    )
    parser.add_argument("trial", type=Path, metavar="TRIAL", help="folder of a trial")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Rebuild, show the summary, and say whether bytes changed."""
    rebuilt = rebuild(arguments.trial)
    summary_table(rebuilt.cells)
    print(f"changed: {', '.join(rebuilt.changed)}" if rebuilt.changed else "the same bytes as before")
    return 0
