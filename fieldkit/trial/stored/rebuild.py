"""Rebuild a trial's tables from its plan, journal and raw evidence, without a robot.

The same version of fieldkit gives the same bytes.
"""

from dataclasses import dataclass
from pathlib import Path

from fieldkit.analysis.cells import Cell
from fieldkit.core import files
from fieldkit.core.errors import EvidenceError, shell_command
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import journal, manifest, rows, store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans, verification


@dataclass(frozen=True)
class RebuildResult:
    """Result of `rebuild`.

    Attributes:
        cells: The summary.
        changed: Files whose bytes differ from before, or that were missing.
        expected: Names of the quantities that have an expectation.
        has_manifest: Whether there is a manifest, with which the evidence was verified.
    """

    cells: tuple[Cell, ...]
    changed: tuple[str, ...]
    expected: frozenset[str]
    has_manifest: bool


def rebuild(folder: Path) -> RebuildResult:
    """Write trial.csv and summary.csv of the trial in `folder` again.

    Raises:
        ConfigurationError: `folder` is not a trial, another process runs it, or it cannot be written.
        EvidenceError: The journal cannot be read, or the evidence differs from its checksums; nothing is written
            then.
    """
    plan = plans.read_plan(folder)
    if differences := verification.differences(folder):
        raise EvidenceError(
            "the evidence is not what was measured; the tables are not changed: "
            f"{verification.summarize(differences)}",
            where=str(folder),
            remedy="restore it from a copy; or show the results of the evidence as it is now: "
            + shell_command("fieldkit", "aggregate", folder, "--rebuild"),
        )
    names = (store.TRIAL_CSV, store.SUMMARY_CSV)
    before = {name: _content(folder / name) for name in names}
    entries = journal.history(folder, plan)
    with journal.locked(folder):  # rows that a running trial adds meanwhile would be lost
        table = rows.to_csv(_rows(folder, plan, entries), plan.table)
        rows.summary(folder, plan, table)  # if this fails, nothing has been written yet
        rows.write_table(folder, table)
        cells = rows.write_summary(folder, plan, table)
        if has_manifest := (folder / store.MANIFEST_FILE).exists():
            manifest.Manifest(folder).renew(names)
    changed = tuple(name for name in names if _content(folder / name) != before[name])
    expected = frozenset(expectation.quantity for expectation in plan.procedure.expectations)
    return RebuildResult(cells=cells, changed=changed, expected=expected, has_manifest=has_manifest)


def measure_rows(folder: Path, plan: Plan) -> list[Row]:
    """Return the rows of a trial's attempts, measured again from the evidence; nothing is written.

    Raises:
        EvidenceError: As for `journal.history`.
    """
    return _rows(folder, plan, journal.history(folder, plan))


def _rows(folder: Path, plan: Plan, entries: list[JournalEntry]) -> list[Row]:
    attempts = journal.ended_attempts(entries)
    return [
        rows.measure_row(plan, attempt, AttemptEvidence(store.attempt_folder(folder, attempt.folder)))
        for attempt in attempts
    ]


def _content(path: Path) -> bytes | None:
    return files.read(path) if path.exists() else None
