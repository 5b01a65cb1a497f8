"""Print the results of trials: a table per condition, what failed, and the exit code."""

from collections.abc import Sequence

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.wording import Scale
from fieldkit.cli.display import show_error, table
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


def summary_table(cells: Sequence[Cell]) -> None:
    """Print per condition a table: measures down, protocols across, each value with its 95 % interval."""
    groups: dict[tuple[str | float | None, ...], list[Cell]] = {}
    for one in cells:
        condition = tuple(one.key[name] for name in ("procedure", "distance", "topology", "backend"))
        groups.setdefault(condition, []).append(one)
    for condition, group in groups.items():
        rows = [
            ("repeats", *map(wording.counts, group)),
            *(
                (wording.label(one), *(_value(cell, one, wording.scale(one, group)) for cell in group))
                for one in wording.measured(group)
            ),
        ]
        head = ("[95 % interval]", *(str(one.key["protocol"]).upper() for one in group))
        table(head, rows, title=", ".join(str(part) for part in condition), right=range(1, len(group) + 1))
    for caution in wording.cautions(cells):
        print(caution)


def _value(one: Cell, quantity: Quantity, scale: Scale) -> str:
    found = one.estimates.get(quantity.name)
    if found is None:
        return ""
    return f"{scale.amount(found.value)} {wording.interval(scale, found)}".rstrip()
