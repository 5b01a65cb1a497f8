"""The ledger of a trial: what became of each attempt, in journal, folders, rows and manifest, on disk at once."""

import time
from pathlib import Path

from fieldkit.analysis.cells import Cell
from fieldkit.core.columns import Measured
from fieldkit.core.model import RepeatId, Status
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates, journal, rows, store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import Attempt, JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.stop import Stop


class Ledger:
    """Begins and ends attempts; opened on a folder with a past, it knows that too.

    Args:
        plan: The trial.
        folder: Its folder.
        stop: Waits until what is being written is whole.

    Raises:
        EvidenceError: The journal is damaged before its last line.
    """

    def __init__(self, plan: Plan, folder: Path, stop: Stop) -> None:
        self._plan = plan
        self._folder = folder
        self._stop = stop
        self._manifest = store.Manifest(folder)
        self._rows: list[Row] = []
        self._attempts: list[Attempt] = []
        journal.mend(folder)
        past = journal.read(folder)
        if not past:
            now = time.time_ns()
            planned = (
                JournalEntry(now, repeat.protocol, repeat.number, 0, Status.PLANNED) for repeat in plan.order()
            )
            journal.append(folder, *planned)
        for attempt in journal.ended(past):
            evidence = store.attempt_folder(folder, attempt.folder)
            measured = gates.judge(plan, attempt.repeat, AttemptEvidence(evidence)).measured
            self._enter(attempt, evidence, measured)
        self.cut_short = tuple(journal.cut_short(past))
        """Attempts that fieldkit was killed in; each is to be kept before anything else."""

    @property
    def last(self) -> tuple[Attempt, Row]:
        """The attempt kept last, and its row."""
        return self._attempts[-1], self._rows[-1]

    def counts(self, status: Status) -> int:
        """Return how many attempts ended so."""
        return sum(attempt.status is status for attempt in self._attempts)

    def is_over(self, repeat: RepeatId) -> bool:
        """Return whether a repeat is valid, or failed for good."""
        final = {Status.VALID, Status.FAILED}
        return any(attempt.repeat == repeat and attempt.status in final for attempt in self._attempts)

    @property
    def done(self) -> int:
        """Number of repeats that are over."""
        return sum(map(self.is_over, self._plan.order()))

    def is_last(self, repeat: RepeatId) -> bool:
        """Return whether the procedure allows one more attempt at a repeat only."""
        spent = sum(one.repeat == repeat and not one.excused for one in self._attempts)
        return spent + 1 >= self._plan.procedure.attempts

    def begin(self, repeat: RepeatId) -> Attempt:
        """Enter a new attempt as running; returns once that is on disk.

        Raises:
            OSError: The disk is full or gone.
        """
        number = 1 + max((one.number for one in self._attempts if one.repeat == repeat), default=0)
        begun = Attempt(repeat, number, time.time_ns(), Status.RUNNING)
        self._append(begun, begun.started_utc_ns)
        self._manifest.write()
        return begun

    def measured(self, attempt: Attempt) -> None:
        """Enter that the steps of an attempt are done and its evidence waits on the robots; errors as `begin`."""
        self._append(attempt, time.time_ns(), Status.MEASURED)

    def keep(self, evidence: Path, attempt: Attempt, measured: Measured) -> None:
        """Bring an attempt that ended to disk: its evidence, then the journal's word on it, then what is derived.

        Args:
            evidence: Folder of its files, which gets its final name.
            attempt: What became of it.
            measured: What its evidence says.

        Raises:
            OSError: As `begin`.
        """
        with self._stop.whole():
            final = store.keep_attempt(evidence, attempt.folder)
            self._append(attempt, time.time_ns())
            self._enter(attempt, final, measured)
            rows.write_rows(self._folder, self._rows)
            self._manifest.write()

    def summarize(self) -> tuple[Cell, ...]:
        """Write rows and summary of the attempts kept so far and return the summary; errors as `begin`."""
        with self._stop.whole():
            rows.write_rows(self._folder, self._rows)  # a kill may have come between the journal and the last row
            cells = rows.write_summary(self._folder, self._rows)
            self._manifest.write()
        return cells

    def _append(self, attempt: Attempt, utc_ns: int, status: Status | None = None) -> None:
        entry = JournalEntry(
            utc_ns=utc_ns,
            protocol=attempt.repeat.protocol,
            number=attempt.repeat.number,
            attempt=attempt.number,
            status=status or attempt.status,
            reason=attempt.reason,
            excused=attempt.excused,
        )
        journal.append(self._folder, entry)

    def _enter(self, attempt: Attempt, evidence: Path, measured: Measured) -> None:
        self._attempts.append(attempt)
        self._rows.append(rows.build(self._plan, attempt, measured))
        self._manifest.add(evidence)
