"""Print the results of trials: a table per condition, what failed, and the exit code."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.judgements import Judgement
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.wording import Scale
from fieldkit.cli.display import fits, prose, show_error, table
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError, typed
from fieldkit.core.units import format_count
from fieldkit.export import junit
from fieldkit.trial import store
from fieldkit.trial.running.runner import Outcome

Row = tuple[str, ...]
_Table = tuple[Row, list[Row]]
"""Its head and its rows."""


def report(outcomes: Sequence[Outcome | None], arguments: argparse.Namespace) -> int:
    """Print the table of each trial that was not left for later, and return the exit code of all.

    Args:
        outcomes: What trials came to.
        arguments: Of the command: `json`, which prints no table, and `junit`, a file that gets them too.
    """
    ended, quiet = [outcome for outcome in outcomes if outcome is not None], arguments.json
    for outcome in ended:
        if not quiet:
            summary_table(outcome.cells)
            expectation_table(outcome.judgements)
        if outcome.failed:
            reasons = outcome.folder / store.TRIAL_CSV
            failed, cell = format_count(outcome.failed, "repeat"), outcome.cells[0].key
            remedy = f"fieldkit check {cell['procedure']} --topology {cell['topology']}"
            show_error(f"{failed} failed; reasons in {reasons}\n  remedy: {remedy}")
    skipped = len(outcomes) - len(ended)
    if skipped:
        show_error(f"{skipped} of {len(outcomes)} skipped\n  remedy: run the command again for what was skipped")
    keep_junit(arguments, [outcome.folder for outcome in ended])
    if any(outcome.failed for outcome in ended):
        return EvidenceError.exit_code
    unmet = any(not one.holds for outcome in ended for one in outcome.judgements)
    return FieldkitError.exit_code if skipped or unmet else 0


def keep_junit(arguments: argparse.Namespace, folders: Sequence[Path]) -> None:
    """Write trials as JUnit XML where `--junit` asks for it.

    Raises:
        ConfigurationError: The file cannot be written.
    """
    if arguments.junit is None:
        return
    try:
        junit.write(arguments.junit, folders)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}",
            where=str(arguments.junit),
            remedy=typed("fieldkit", "export", "--format", "junit", "-o", "FILE", *folders),
        ) from error


def summary_table(cells: Sequence[Cell]) -> None:
    """Print per condition a table: measures down, protocols across, each value with its 95 % interval.

    Where the terminal is too narrow for that, each protocol has a table of its own; and where that is too wide,
    intervals stand below their values, and words are folded.
    """
    groups: dict[tuple[str | float | None, ...], list[Cell]] = {}
    for one in cells:
        condition = tuple(one.key[name] for name in ("procedure", "distance", "topology", "backend"))
        groups.setdefault(condition, []).append(one)
    for condition, group in groups.items():
        title = ", ".join(str(part) for part in condition)
        layouts: Sequence[tuple[list[_Table], Sequence[int]]] = (
            ([_summary(group)], ()),
            ([_summary([one]) for one in group], ()),
            ([_summary([one], between="\n") for one in group], (0,)),
        )
        tables, fold = next((one for one in layouts if all(fits(*made) for made in one[0])), layouts[-1])
        for head, rows in tables:
            table(head, rows, title=title, right=range(1, len(head)), fold=fold)
    for caution in wording.cautions(cells):
        prose(caution)


def _summary(group: Sequence[Cell], between: str = " ") -> _Table:
    """Return the head and the rows of a table of one condition, with this between the parts of a cell."""
    rows = [
        ("repeats", *map(wording.counts, group)),
        *(
            (wording.label(one), *(_value(cell, one, wording.scale(one, group), between) for cell in group))
            for one in wording.measured(group)
        ),
        *(
            (label, *(wording.tally(cell, name, f",{between}") for cell in group))
            for name, label in wording.worded(group).items()
        ),
    ]
    return ("[95 % interval]", *(str(one.key["protocol"]).upper() for one in group)), rows


def expectation_table(judgements: Sequence[Judgement]) -> None:
    """Print what the figures say of expectations, a line each; nothing where nothing was expected."""
    if judgements:
        rows = [wording.judged(one) for one in judgements]
        table(("expected", "of", "measured", "[95 % interval]", ""), rows, fold=(0, 4))


def _value(one: Cell, quantity: Quantity, scale: Scale, between: str) -> str:
    found = one.estimates.get(quantity.name)
    if found is None:
        return ""
    return f"{scale.amount(found.value)}{between}{wording.interval(scale, found)}".rstrip()
