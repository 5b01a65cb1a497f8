"""What trials came to: their tables, what failed, and the exit code."""

from collections.abc import Sequence

from fieldkit.cli.display import show_error
from fieldkit.cli.summary import summary_table
from fieldkit.core.errors import EvidenceError, FieldkitError
from fieldkit.core.units import format_count
from fieldkit.trial import store
from fieldkit.trial.runner import Outcome


def report(outcomes: Sequence[Outcome | None], *, quiet: bool) -> int:
    """Print the table of each trial that was not left for later, and return the exit code of all."""
    ended = [outcome for outcome in outcomes if outcome is not None]
    for outcome in ended:
        if not quiet:
            summary_table(outcome.cells)
        if outcome.failed:
            reasons = outcome.folder / store.TRIAL_CSV
            failed, cell = format_count(outcome.failed, "repeat"), outcome.cells[0].key
            remedy = f"fieldkit check {cell['procedure']} --topology {cell['topology']}"
            show_error(f"{failed} failed; reasons in {reasons}\n  remedy: {remedy}")
    skipped = len(outcomes) - len(ended)
    if skipped:
        show_error(f"{skipped} of {len(outcomes)} skipped\n  remedy: run the command again for what was skipped")
    if any(outcome.failed for outcome in ended):
        return EvidenceError.exit_code
    return FieldkitError.exit_code if skipped else 0
