"""`fieldkit campaign FILE`: a day of trials."""

import argparse
from pathlib import Path

from fieldkit.campaign import plan
from fieldkit.campaign.journal import CampaignJournal
from fieldkit.campaign.runner import CampaignOutcome, CampaignRun
from fieldkit.cli import options, results
from fieldkit.cli.display import show_error, watching
from fieldkit.cli.terminal import interruptible
from fieldkit.core.errors import EvidenceError, FieldkitError, typed
from fieldkit.core.units import format_count


def run(arguments: argparse.Namespace) -> int:
    """Run what is left of the campaign."""
    with watching(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = options.backend(arguments, sink)
        asked, document = plan.make_plan(arguments.file, name)
        folder = arguments.out / f"campaign_{asked.campaign.name}"
        begun = plan.begun(folder, asked, document)
        campaign = CampaignRun(begun or asked, CampaignJournal(folder), backend, sink)
        campaign.announce()
        if arguments.dry_run:
            return 0
        with options.operator(arguments, sink) as operator:
            outcome = campaign.run(operator, stop)
    results.keep_junit(arguments, outcome.folders)
    return _code(outcome, folder)


def _code(outcome: CampaignOutcome, folder: Path) -> int:
    if outcome.failed:
        failed = format_count(outcome.failed, "repeat")
        show_error(f"{failed} failed; reasons in the trial.csv of each trial below {folder}")
    if outcome.left:
        names = ", ".join(map(str, outcome.left))
        show_error(f"skipped: {names}\n  remedy: give the same command again to run what was skipped")
    if outcome.unmet:
        unmet = format_count(outcome.unmet, "expectation")
        show_error(f"{unmet} not shown to hold\n  remedy: {typed('fieldkit', 'aggregate', folder)} tells which")
    if outcome.failed:
        return EvidenceError.exit_code
    return FieldkitError.exit_code if outcome.left or outcome.unmet else 0
