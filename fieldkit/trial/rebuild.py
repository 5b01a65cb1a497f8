"""Make a trial's tables again from plan, journal and raw evidence alone: the same bytes, with no robot."""

from dataclasses import dataclass
from pathlib import Path

from fieldkit.analysis.cells import Cell
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates, journal, rows, store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan


@dataclass(frozen=True)
class Rebuilt:
    """Result of `rebuild`.

    Attributes:
        cells: The summary.
        changed: Files whose bytes differ from what stood there before; files that were missing count.
    """

    cells: tuple[Cell, ...]
    changed: tuple[str, ...]


def rebuild(folder: Path) -> Rebuilt:
    """Write trial.csv and summary.csv of the trial in `folder` anew.

    Raises:
        ConfigurationError: `folder` is no trial.
        EvidenceError: The journal cannot be read.
    """
    plan = store.read_plan(folder)
    names = (store.TRIAL_CSV, store.SUMMARY_CSV)
    before = {name: _content(folder / name) for name in names}
    table = measured(folder, plan)
    rows.write_rows(folder, table)
    cells = rows.write_summary(folder, table)
    changed = tuple(name for name in names if _content(folder / name) != before[name])
    return Rebuilt(cells=cells, changed=changed)


def measured(folder: Path, plan: Plan) -> list[Row]:
    """Return the rows of a trial's attempts, measured again; nothing is written.

    Raises:
        EvidenceError: The journal cannot be read.
    """
    attempts = journal.ended(journal.read(folder))
    return [row(plan, attempt, AttemptEvidence(store.attempt_folder(folder, attempt.folder))) for attempt in attempts]


def row(plan: Plan, attempt: Attempt, evidence: AttemptEvidence) -> Row:
    """Return the row of an attempt; what its evidence does not say is missing."""
    return rows.build(plan, attempt, gates.judge(plan, attempt.repeat, evidence).measured)


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None
