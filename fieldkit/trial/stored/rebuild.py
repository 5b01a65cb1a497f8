"""Rebuild the tables of a trial from its plan, journal and raw evidence, without a robot.

The same version of fieldkit writes the same bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldkit.analysis.cells import Cell
from fieldkit.core import files
from fieldkit.core.errors import EvidenceError, shell_command
from fieldkit.core.model import Status
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates, journal, manifest, rows, store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans, verification


@dataclass(frozen=True)
class RebuildResult:
    """Result of `rebuild`.

    Attributes:
        cells: Summary of the trial.
        changed: Files that changed or were missing.
        expected: Names of the quantities that have an expectation.
        has_manifest: True if there is a manifest, with which the evidence was compared.
        problems: Problems that the installed code reports about attempts that were valid when they ended; because of
            them, values may be missing.
    """

    cells: tuple[Cell, ...]
    changed: tuple[str, ...]
    expected: frozenset[str]
    has_manifest: bool
    problems: tuple[str, ...] = ()


def rebuild(folder: Path) -> RebuildResult:
    """Write trial.csv and summary.csv of the trial in `folder` again.

    Raises:
        ConfigurationError: `folder` is not a trial, another process runs the trial, or a file cannot be written.
        EvidenceError: The journal cannot be read, or the evidence differs from its checksums. Nothing is written.
    """
    plan = plans.read_plan(folder)
    if differences := verification.differences(folder):
        raise EvidenceError(
            "the evidence has changed since it was measured, so the tables are not rebuilt: "
            f"{verification.summarize(differences)}",
            where=str(folder),
            remedy="restore it from a copy; or show the results of the current evidence: "
            + shell_command("fieldkit", "aggregate", folder, "--rebuild"),
        )
    names = (store.TRIAL_CSV, store.SUMMARY_CSV)
    before = {name: _content(folder / name) for name in names}
    entries = journal.history(folder, plan)
    with journal.locked(folder):  # otherwise rows that a running trial adds would be lost
        measured_rows, problems = _measure(folder, plan, entries)
        table = rows.to_csv(measured_rows, plan.table)
        rows.summary(folder, plan, table)  # raises errors before a file is written
        rows.write_table(folder, table)
        cells = rows.write_summary(folder, plan, table)
        if has_manifest := (folder / store.MANIFEST_FILE).exists():
            manifest.Manifest(folder).renew(names)
    changed = tuple(name for name in names if _content(folder / name) != before[name])
    expected = frozenset(expectation.quantity for expectation in plan.procedure.expectations)
    return RebuildResult(
        cells=cells, changed=changed, expected=expected, has_manifest=has_manifest, problems=tuple(problems)
    )


def problems_text(problems: Sequence[str]) -> str:
    """Return the text of a note on the problems of attempts that were valid when they ended."""
    more_text = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"valid repeats may lack values now: {problems[0]}{more_text}"


def measure_rows(folder: Path, plan: Plan) -> tuple[list[Row], list[str]]:
    """Measure the rows of a trial's attempts again from the evidence. Nothing is written.

    Returns:
        The rows, and the problems as in `RebuildResult`.

    Raises:
        EvidenceError: For the same reasons as `journal.history`.
    """
    return _measure(folder, plan, journal.history(folder, plan))


def _measure(folder: Path, plan: Plan, entries: list[JournalEntry]) -> tuple[list[Row], list[str]]:
    """Return the rows of a trial's attempts, and the problems of those that were valid when they ended."""
    measured_rows: list[Row] = []
    problems: list[str] = []
    for attempt in journal.ended_attempts(entries):
        evidence = AttemptEvidence(store.attempt_folder(folder, attempt.folder))
        verdict = gates.judge(plan, attempt.repeat, evidence)
        measured_rows.append(rows.build(plan, attempt, verdict.measured))
        if attempt.status is Status.VALID:
            problems += (f"{attempt.folder}: {problem}" for problem in verdict.problems)
    return measured_rows, problems


def _content(path: Path) -> bytes | None:
    return files.read(path) if path.exists() else None
