"""`fieldkit rebuild TRIAL...`: regenerate the tables from raw evidence."""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import print_folded, show_error, show_note, showing_progress
from fieldkit.cli.parser import Parser
from fieldkit.core.text import print_text

if TYPE_CHECKING:
    from fieldkit.trial.stored.rebuild import RebuildResult


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit rebuild`."""
    parser.description = (
        "Regenerate trial.csv and summary.csv from plan, journal and raw evidence. The result is byte-identical if "
        "the evidence and the version of fieldkit are the same."
    )
    parser.add_argument(
        "trial",
        type=Path,
        nargs="+",
        metavar="TRIAL",
        help="folder of a trial, or folder with trials at any depth",
    )
    shared.add_all(parser)
    shared.add_workers(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Rebuild the tables; print the names of the changed files, and the summary if there is only one trial."""
    from fieldkit.trial.stored import rebuild, sources

    paths: list[Path] = arguments.trial
    folders = [folder for path in paths for folder in sources.trial_folders(path) or [path]]
    if len(folders) > 1:
        return _rebuild_many(folders, arguments)
    rebuilt = rebuild.rebuild(folders[0])
    _show_notes(folders[0], rebuilt)
    _show_summary(rebuilt, show_all=arguments.all)
    print_text(_changes(rebuilt))
    return 0


def _show_summary(rebuilt: "RebuildResult", *, show_all: bool) -> None:
    from fieldkit.cli import results

    if omitted_count := results.show_summary(rebuilt.cells, show_all=show_all, expected=rebuilt.expected):
        print_folded(f"{results.more_quantities_text(omitted_count)}: add --all")


def _rebuild_many(folders: Sequence[Path], arguments: argparse.Namespace) -> int:
    """Rebuild many trials in parallel, and print a line for each; an error does not stop the others."""
    from fieldkit.core.errors import FieldkitError
    from fieldkit.core.events import Progress
    from fieldkit.core.executors import Workers
    from fieldkit.core.tasks import completed
    from fieldkit.trial.stored import rebuild

    # Workers of a cluster have another working directory.
    absolute_folders = [folder.absolute() for folder in folders]
    exit_code = 0
    with showing_progress() as sink:
        report = partial(Progress, "rebuild", total=len(folders), unit="trials")
        workers = Workers(arguments.jobs, arguments.cluster)
        for done, end in enumerate(completed(rebuild.rebuild, absolute_folders, workers, show_note), start=1):
            sink(report(done=done))
            folder = folders[end.number]
            if end.result is not None:
                _show_notes(folder, end.result)
                print_text(f"{folder}: {_changes(end.result)}")
            elif isinstance(end.error, FieldkitError):
                show_error(str(end.error) if end.error.where else f"{folder}: {end.error}")
                exit_code = exit_code or end.error.exit_code
            elif end.error is not None:
                raise end.error
    return exit_code


def _show_notes(folder: Path, rebuilt: "RebuildResult") -> None:
    from fieldkit.trial.stored.rebuild import problems_text

    if not rebuilt.has_manifest:
        show_note(f"{folder}: there is no manifest to verify its evidence with")
    if rebuilt.problems:
        show_note(f"{folder}: {problems_text(rebuilt.problems)}")


def _changes(rebuilt: "RebuildResult") -> str:
    return f"changed: {', '.join(rebuilt.changed)}" if rebuilt.changed else "the same bytes as before"
