"""`fieldkit rebuild TRIAL`: the tables again, from raw evidence."""

import argparse

from fieldkit.cli.display import show_note
from fieldkit.cli.results import summary_table
from fieldkit.trial.rebuild import rebuild


def run(arguments: argparse.Namespace) -> int:
    """Rebuild, show the summary, and say whether bytes changed."""
    rebuilt = rebuild(arguments.trial)
    if not rebuilt.is_summed:
        show_note(f"{arguments.trial}: there is no manifest to say whether its evidence is as it was kept")
    summary_table(rebuilt.cells)
    print(f"changed: {', '.join(rebuilt.changed)}" if rebuilt.changed else "the same bytes as before")
    return 0
