"""Tables of trials that are measured again from the raw evidence, without writing anything."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.executors import Workers
from fieldkit.core.tasks import completed
from fieldkit.trial import rows, store
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import plans, rebuild, verification

_MIN_PARALLEL_TRIALS: Final = 8
"""Smallest number of trials that are measured in parallel by default, because starting processes takes a second."""

Note = Callable[[str], None]
"""Function that shows a sentence about evidence that has changed, or values that may be missing."""


def table_reader(tables: Sequence[Path], workers: Workers, note: Note) -> Callable[[Path], bytes]:
    """Return a function that returns the table of a trial, measured again from its raw evidence."""
    if workers.is_default and len(tables) < _MIN_PARALLEL_TRIALS:
        return partial(_measure, note=note)
    contents: dict[Path, bytes] = {}
    absolute = [table.absolute() for table in tables]  # workers of a cluster have another working directory
    for end in completed(_measure_with_notes, absolute, workers, note):
        if end.result is None:
            raise end.error or EvidenceError("no table was measured", where=str(tables[end.number]))
        contents[tables[end.number]], notes = end.result
        for text in notes:
            note(text)
    return contents.__getitem__


def _measure_with_notes(table: Path) -> tuple[bytes, list[str]]:
    """Return a trial's table, measured again, and the notes on it."""
    notes: list[str] = []
    return _measure(table, notes.append), notes


def _measure(table: Path, note: Note) -> bytes:
    """Return a trial's table, measured again from its raw evidence."""
    folder = table.parent
    if table.name != store.TRIAL_CSV or not (folder / PLAN_FILE).is_file():
        raise ConfigurationError(
            "a table alone has no raw evidence to rebuild from",
            where=str(table),
            remedy="name the folder of the trial, or leave out --rebuild",
        )
    plan = plans.read_plan(folder)
    note_differences(folder, note)
    measured_rows, problems = rebuild.measure_rows(folder, plan)
    if problems:
        note(f"{folder}: {rebuild.problems_text(problems)}")
    return rows.to_csv(measured_rows, plan.table).encode()


def note_differences(folder: Path, note: Note) -> None:
    """Show a note if the evidence that is measured again has changed since it was first measured."""
    if differences := verification.differences(folder):
        note(f"{folder}: measured from changed evidence: {verification.summarize(differences)}")
