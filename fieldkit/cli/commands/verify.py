"""`fieldkit verify TRIAL`: every file against the manifest."""

import argparse

from fieldkit.cli.display import show_error
from fieldkit.core.errors import EvidenceError
from fieldkit.core.units import format_count
from fieldkit.trial.manifest import verify


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
