"""`fieldkit campaign FILE`: run a file of trials."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_error, showing_events
from fieldkit.cli.interrupts import interruptible
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import EvidenceError, FieldkitError, shell_command
from fieldkit.core.units import format_count

if TYPE_CHECKING:
    from fieldkit.campaign.runner import CampaignOutcome


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit campaign`."""
    parser.description = (
        "Run the trials of a campaign file in a shuffled order; the same command continues them later."
    )
    parser.epilog = "example: fieldkit campaign lawn.yaml --dry-run"
    parser.add_argument("file", type=Path, metavar="FILE", help="campaign file, see `fieldkit docs campaign`")
    shared.add_site(parser)
    shared.add_out(parser, "the folder of the campaign")
    parser.add_argument(
        "--dry-run", action="store_true", help="print order, route, time and disk space; change nothing"
    )
    parser.add_argument("--failed", action="store_true", help="also repeat the failed repeats")
    shared.add_json(parser)
    shared.add_operator(parser)
    shared.add_junit(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the remaining trials of the campaign."""
    from fieldkit.campaign import plan
    from fieldkit.campaign.journal import CampaignJournal
    from fieldkit.campaign.runner import CampaignRun
    from fieldkit.cli import cli_options, results

    with showing_events(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = cli_options.backend(arguments, sink)
        current_plan, document = plan.make_plan(arguments.file, name)
        if (
            not arguments.dry_run
            and (code := cli_options.run_elsewhere(backend, arguments, arguments.out)) is not None
        ):
            return code
        folder = arguments.out / f"campaign_{current_plan.campaign.name}"
        started_plan = plan.started_plan(folder, current_plan, document)
        campaign = CampaignRun(
            started_plan or current_plan, CampaignJournal(folder), backend, sink, failed=arguments.failed
        )
        campaign.announce()
        if arguments.dry_run:
            return 0
        with cli_options.operator(arguments, sink) as operator:
            outcome = campaign.run(operator, stop)
    results.write_junit(arguments, outcome.folders)
    return _report_outcome(outcome, arguments.file, folder)


def _report_outcome(outcome: "CampaignOutcome", file: Path, folder: Path) -> int:
    """Print failed repeats, skipped trials and unmet expectations with remedies; return the exit code."""
    if outcome.failed:
        failed = format_count(outcome.failed, "repeat")
        command = shell_command("fieldkit", "campaign", file, "--failed")
        remedy = f"remove the causes, then add --failed: {command}"
        show_error(f"{failed} failed; reasons in the trial.csv of each trial below {folder}\n  remedy: {remedy}")
    if outcome.remaining:
        names = ", ".join(map(str, outcome.remaining))
        show_error(f"skipped: {names}\n  remedy: to run the skipped trials, run the same command again")
    if outcome.unmet:
        unmet = format_count(outcome.unmet, "expectation")
        show_error(
            f"{unmet} not met or undecided\n  remedy: {shell_command('fieldkit', 'aggregate', folder)} lists them"
        )
    if outcome.failed:
        return EvidenceError.exit_code
    return FieldkitError.exit_code if outcome.remaining or outcome.unmet else 0
