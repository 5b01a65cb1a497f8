"""Print the results of trials: a table per condition, failures, and next commands."""

import argparse
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fieldkit.analysis import table_lines, wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.table_lines import TableLine
from fieldkit.cli.display import fits_terminal, print_folded, print_table, show_error
from fieldkit.cli.hints import add_options
from fieldkit.core.columns import plain_name
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError, shell_command
from fieldkit.core.text import print_text
from fieldkit.core.units import format_count, plain_number
from fieldkit.trial import store
from fieldkit.trial.running.runner import Outcome

if TYPE_CHECKING:
    from fieldkit.analysis.judgements import Judgement

Row = tuple[str, ...]
_SummaryTable = tuple[Row, list[Row]]
"""Head and rows of a table."""


def show_summary(cells: Sequence[Cell], *, show_all: bool = False, expected: Collection[str] = ()) -> int:
    """Print a table per condition, each value with its 95 % interval, and return the number of omitted quantities.

    If the terminal is too narrow for that, each protocol has a separate table; if that is still too wide, intervals
    are below their values and labels are folded.

    Args:
        cells: The cells to show.
        show_all: True to show all quantities, not only the quantities of `table_lines.operator_lines`.
        expected: Names of quantities with an expectation. They are always shown.
    """
    groups: dict[tuple[str | float | None, ...], list[Cell]] = {}
    for cell in cells:
        condition = tuple(cell.key[name] for name in ("procedure", "distance", "topology", "backend"))
        groups.setdefault(condition, []).append(cell)
    omitted_names, names = set[str](), set[str]()
    for condition, group in groups.items():
        title = ", ".join(str(part) for part in condition)
        shown_lines = (
            table_lines.lines(group)
            if show_all
            else table_lines.with_radio_loss(table_lines.operator_lines(group, expected), group)
        )
        names |= (group_names := {quantity.name for line in shown_lines for quantity in line.quantities})
        omitted_names |= {quantity.name for quantity in wording.measured(group)} - group_names
        layouts: Sequence[tuple[list[_SummaryTable], Sequence[int]]] = (
            ([_summary(group, shown_lines)], ()),
            ([_summary([cell], shown_lines) for cell in group], ()),
            ([_summary([cell], shown_lines, separator="\n") for cell in group], (0,)),
        )
        tables, fold = next(
            (layout for layout in layouts if all(fits_terminal(*part) for part in layout[0])), layouts[-1]
        )
        for head, rows in tables:
            print_table(head, rows, title=title, right=range(1, len(head)), fold=fold)
    for caution in wording.cautions(cells, names):
        print_folded(caution)
    return len(omitted_names)


def _summary(group: Sequence[Cell], shown_lines: Sequence[TableLine], separator: str = " ") -> _SummaryTable:
    """Return the head and the rows of a table with a column per cell in `group`, whose cells differ in the protocol.

    `separator` is between the value, the interval and the note of a figure.
    """
    figures = [
        (line.label, *(line.amount(cell, line.scale(group), separator) for cell in group)) for line in shown_lines
    ]
    words = [
        (label, *(wording.tally(cell, name, f",{separator}") for cell in group))
        for name, label in wording.word_labels(group).items()
    ]
    sent = [(label, *counts) for label, counts in table_lines.sent_counts(group).items()]
    rows = [("repeats", *map(wording.counts, group)), *sent, *(row for row in figures if any(row[1:])), *words]
    return ("[95 % interval]", *(str(cell.key["protocol"]).upper() for cell in group)), rows


def more_quantities_text(count: int) -> str:
    """Return the number of omitted quantities as text, such as `3 more quantities`."""
    return f"{count} more {'quantity' if count == 1 else 'quantities'}"


_LENGTH: Final = re.compile(r"(?P<number>[0-9]+(?:\.[0-9]+)?)(?P<unit>[a-z]+)")


def report(outcomes: Sequence[Outcome | None], arguments: argparse.Namespace) -> int:
    """Print the table of each trial that was not skipped, and return the exit code for all trials.

    Args:
        outcomes: The outcomes of trials, None for each skipped trial.
        arguments: The arguments of the command: `json` prints no table, `all` prints all quantities, and `junit` is a
            file to which the results are also written.
    """
    outcomes_run, is_json = [outcome for outcome in outcomes if outcome is not None], arguments.json
    omitted_count = 0
    for outcome in outcomes_run:
        if not is_json:
            expected = {judgement.expectation.quantity for judgement in outcome.judgements}
            omitted_count = max(omitted_count, show_summary(outcome.cells, show_all=arguments.all, expected=expected))
            print_expectations(outcome.judgements)
        if outcome.failed:
            reasons = outcome.folder / store.TRIAL_CSV
            failed = format_count(outcome.failed, "repeat")
            command = shell_command("fieldkit", "resume", outcome.folder, "--failed")
            remedy = f"remove the causes, then run: {command}"
            show_error(f"{failed} failed; reasons in {reasons}\n  remedy: {remedy}")
    if not is_json:
        _show_next(outcomes_run, omitted_count)
    skipped = len(outcomes) - len(outcomes_run)
    if skipped:
        show_error(
            f"{skipped} of {format_count(len(outcomes), 'trial')} skipped\n"
            "  remedy: to run the skipped trials, run the command again"
        )
    write_junit(arguments, [outcome.folder for outcome in outcomes_run])
    if any(outcome.failed for outcome in outcomes_run):
        return EvidenceError.exit_code
    has_unmet = any(not judgement.holds for outcome in outcomes_run for judgement in outcome.judgements)
    return FieldkitError.exit_code if skipped or has_unmet else 0


def write_junit(arguments: argparse.Namespace, folders: Sequence[Path]) -> None:
    """Write trials as JUnit XML into the file of `--junit`, if given.

    Raises:
        ConfigurationError: The file cannot be written.
    """
    if arguments.junit is None:
        return
    from fieldkit.export import junit  # noqa: PLC0415 (few trials write this file)

    try:
        junit.write(arguments.junit, folders)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}",
            where=str(arguments.junit),
            remedy=shell_command("fieldkit", "export", "--format", "junit", "-o", "FILE", *folders),
        ) from error


def print_expectations(judgements: "Sequence[Judgement]") -> None:
    """Print a row for each expectation with its judgement. Without expectations, print nothing."""
    if judgements:
        from fieldkit.analysis.judgement_words import judgement_texts  # noqa: PLC0415 (few procedures have expectations)

        rows = [judgement_texts(judgement) for judgement in judgements]
        print_table(("expected", "of", "measured", "[95 % interval]", ""), rows, fold=(0, 4))


def _show_next(outcomes_run: Sequence[Outcome], omitted_count: int) -> None:
    """Print likely next commands if at least one repeat is valid."""
    if any(outcome.valid for outcome in outcomes_run):
        for index, command in enumerate(_next_commands(outcomes_run, omitted_count)):
            # The command is not folded, so that it can be copied.
            print_text(f"{'      ' if index else 'next: '}{add_options(command)}")


def _next_commands(outcomes_run: Sequence[Outcome], omitted_count: int) -> Iterator[str]:
    folders = [outcome.folder for outcome in outcomes_run]
    yield shell_command("fieldkit", "report", *folders)
    if omitted_count:
        yield f"{shell_command('fieldkit', 'aggregate', *folders, '--all')}  # {more_quantities_text(omitted_count)}"
    cells = [cell for outcome in outcomes_run for cell in outcome.cells[:1]]
    next_distance = _next_distance([str(cell.key["distance"]) for cell in cells])
    if next_distance and not any(_lost_all(cell) for outcome in outcomes_run for cell in outcome.cells):
        yield f"{shell_command('fieldkit', 'trial', cells[-1].key['procedure'], next_distance)}  # another distance"


def _lost_all(cell: Cell) -> bool:
    """Return True if at least one step of a cell received no answer to a ping. Then no next distance is suggested."""
    return any(plain_name(name) == "rtt_loss" and estimate.value >= 1 for name, estimate in cell.estimates.items())


def _next_distance(distances: Sequence[str]) -> str:
    """Return the last distance increased by its difference to the previous one.

    A single distance is doubled, as is the last one if the previous one has another unit. Empty if the last two
    distances are words or equal.
    """
    matches = [match for distance in distances[-2:] if (match := _LENGTH.fullmatch(distance))]
    if not matches:
        return ""
    last_value = float(matches[-1]["number"])
    previous_value = (
        float(matches[0]["number"]) if len(matches) > 1 and matches[0]["unit"] == matches[1]["unit"] else 0.0
    )
    return (
        f"{plain_number(last_value + abs(last_value - previous_value), 9)}{matches[-1]['unit']}"
        if last_value != previous_value
        else ""
    )
