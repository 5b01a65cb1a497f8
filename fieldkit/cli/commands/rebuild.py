"""`fieldkit rebuild TRIAL`: regenerate the tables from raw evidence."""

import argparse

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import print_folded, show_note
from fieldkit.cli.parser import Parser
from fieldkit.core.text import print_text


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit rebuild`."""
    parser.description = (
        "Regenerate trial.csv and summary.csv from plan, journal and raw evidence. The result is byte-identical."
    )
    shared.add_trial(parser)
    shared.add_all(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Rebuild the tables; print the summary and the names of the changed files."""
    from fieldkit.cli import results
    from fieldkit.trial.rebuild import rebuild

    rebuilt = rebuild(arguments.trial)
    if not rebuilt.has_manifest:
        show_note(f"{arguments.trial}: there is no manifest to verify its evidence with")
    if left_out := results.show_summary(rebuilt.cells, show_all=arguments.all, expected=rebuilt.expected):
        print_folded(f"{results.more_rows_note(left_out)}: add --all")
    print_text(f"changed: {', '.join(rebuilt.changed)}" if rebuilt.changed else "the same bytes as before")
    return 0
