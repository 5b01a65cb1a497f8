"""The ledger of a trial, which stores the result of each attempt in journal, folders, table and manifest."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from fieldkit.analysis.cells import Cell
from fieldkit.core import files
from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import RepeatId, Status
from fieldkit.core.text import encodable
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import journal, rows, store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import Attempt, JournalEntry
from fieldkit.trial.manifest import Manifest
from fieldkit.trial.plan import Plan
from fieldkit.trial.running.stop import Stop

TABLE_SHARE: Final = 0.01
"""Table and manifest are rewritten when they lack this share of the attempts: after each attempt in a trial of up to
100 attempts. The total amount of written data is therefore linear in the length of the trial, not quadratic.
"""


class Ledger:
    """Starts and commits attempts. The state of an earlier run of the trial is read first.

    Attempts in the table are not measured again, and files with a checksum are not read again.

    Args:
        plan: The trial.
        folder: Folder of the trial.
        stop: Delays a stop while files are being written.

    Raises:
        EvidenceError: The journal is damaged, or evidence that must be measured again has changed.
    """

    def __init__(self, plan: Plan, folder: Path, stop: Stop) -> None:
        self._plan = plan
        self._folder = folder
        self._stop = stop
        self._lines: list[str] = []
        self._line_count_on_disk = 0
        self._last: tuple[Attempt, Row] | None = None
        self._last_numbers: dict[RepeatId, int] = {}
        self._counted_attempts: Counter[RepeatId] = Counter()
        self._finished: set[RepeatId] = set()
        self._counts: Counter[Status] = Counter()
        journal.remove_torn_line(folder)
        entries = journal.history(folder, plan)
        self._manifest = Manifest(folder)
        if not entries:
            now = time.time_ns()
            planned = (
                JournalEntry(now, repeat.protocol, repeat.number, 0, Status.PLANNED)
                for repeat in plan.repeats_in_order()
            )
            journal.append(folder, *planned)
        ended = journal.ended_attempts(entries)
        for attempt in ended:
            self._rename(attempt)
        self.differences = dict(self._manifest_differences(ended))
        """Differences from the manifest, by file."""
        unchanged_lines = self._unchanged_lines(len(ended))
        remeasured = [
            attempt for index, attempt in enumerate(ended) if index >= len(unchanged_lines) or attempt.reopened
        ]
        if remeasured and self.differences:
            self._require_evidence(remeasured)
        for number, attempt in enumerate(ended):
            evidence = store.attempt_folder(folder, attempt.folder)
            has_line = number < len(unchanged_lines) and not attempt.reopened  # the row of a reopened attempt changes
            row = {} if has_line else rows.measure_row(plan, attempt, AttemptEvidence(evidence))
            self._add_line(attempt, unchanged_lines[number] if has_line else rows.line(row, self._plan.table))
            if attempt.folder not in self._manifest:
                self._manifest.add(evidence)
        self.ended_attempts = tuple(ended)
        """The attempts that ended in earlier runs, in order."""
        self.interrupted_attempts = tuple(journal.interrupted_attempts(entries))
        """Attempts during which fieldkit was killed. They must be completed before other attempts."""

    @property
    def last(self) -> tuple[Attempt, Row]:
        """The last attempt that was committed in this run, and its row. There must be one."""
        assert self._last is not None
        return self._last

    def counts(self, status: Status) -> int:
        """Return the number of attempts with a final status."""
        return self._counts[status]

    def is_finished(self, repeat: RepeatId) -> bool:
        """Return True if a repeat is valid or has failed, so that it needs no further attempt."""
        return repeat in self._finished

    @property
    def finished_count(self) -> int:
        """Number of finished repeats."""
        return len(self._finished)

    def is_last(self, repeat: RepeatId) -> bool:
        """Return True if the procedure allows at most one more attempt at a repeat."""
        return self._counted_attempts[repeat] + 1 >= self._plan.procedure.attempts

    def begin(self, repeat: RepeatId) -> Attempt:
        """Record the start of a new attempt on disk.

        Raises:
            OSError: The disk is full or was removed.
        """
        started = Attempt(repeat, 1 + self._last_numbers.get(repeat, 0), time.time_ns(), Status.RUNNING)
        self._append(started, started.started_utc_ns)
        # In a trial of up to 100 attempts, the manifest then covers the journal entry of this start.
        if self._is_due(len(self._lines) - 1):
            self._manifest.write()
        return started

    def record_measured(self, attempt: Attempt) -> None:
        """Record that the steps of an attempt have ended. Its evidence is on the robots.

        Raises the same errors as `begin`.
        """
        self._append(attempt, time.time_ns(), Status.MEASURED)

    def commit(self, evidence: Path, attempt: Attempt, measured: Measured) -> None:
        """Write an attempt that ended to disk: first its evidence, then its journal entry, then the derived files.

        Args:
            evidence: Folder of the attempt's files, which is renamed to its final name.
            attempt: The attempt with its final status.
            measured: Measured values of the attempt.

        Raises:
            KeyboardInterrupt: A stop was due while the files were being written; they are complete.
            OSError: For the same reasons as `begin`.
        """
        with self._stop.saving_files():
            final = store.commit_attempt(evidence, attempt.folder)
            ended = replace(attempt, reason=encodable(attempt.reason))
            row = rows.build(self._plan, ended, measured)
            self._append(ended, time.time_ns())
            self._add_line(ended, rows.line(row, self._plan.table))
            self._last = ended, row
            self._manifest.add(final)
            if self._is_due(self._line_count_on_disk):
                self._write()

    def summarize(self) -> tuple[Cell, ...]:
        """Write the table and the summary of all committed attempts, and return the summary.

        Raises the same errors as `commit`.
        """
        with self._stop.saving_files():
            cells = rows.write_summary(self._folder, self._plan, self._table())
            self._write()
        return cells

    def _rename(self, attempt: Attempt) -> None:
        """Rename the folder of an attempt to the name of a void attempt if its repeat was reopened later."""
        if not attempt.reopened:
            return
        before = attempt.repeat.folder(Status.FAILED, attempt.number)
        failed, final = (store.attempt_folder(self._folder, name) for name in (before, attempt.folder))
        if failed.is_dir():
            failed.rename(final)
            files.sync_folder(final.parent)
        self._manifest.rename(before, attempt.folder)

    def _is_due(self, line_count: int) -> bool:
        """Return True if a file with the first `line_count` attempts must be written again (see `TABLE_SHARE`)."""
        return len(self._lines) - line_count >= TABLE_SHARE * len(self._lines)

    def _write(self) -> None:
        rows.write_table(self._folder, self._table())
        self._manifest.write()
        self._line_count_on_disk = len(self._lines)

    def _table(self) -> str:
        return rows.header(self._plan.table) + "".join(self._lines)

    def _manifest_differences(self, ended: list[Attempt]) -> Iterator[tuple[str, str]]:
        if not (self._folder / store.MANIFEST_FILE).exists():
            if ended:
                yield store.MANIFEST_FILE, "missing, so changes of the evidence cannot be detected"
            return
        from fieldkit.trial.stored import verification  # noqa: PLC0415 (only a resumed trial has a manifest)

        if self._manifest.unchanged_lines(store.TRIAL_CSV) is None:
            yield store.TRIAL_CSV, "changed"
        yield from verification.differences(self._folder).items()

    def _unchanged_lines(self, ended: int) -> list[str]:
        """Return the unchanged lines of the table without its header.

        The result is empty if the header differs from the plan, or there are more lines than attempts that ended.
        """
        line_count = self._manifest.unchanged_lines(store.TRIAL_CSV)
        if not line_count:
            return []
        text = files.read(self._folder / store.TRIAL_CSV).decode()
        header, *lines = text.splitlines(keepends=True)[:line_count]
        return lines if header == rows.header(self._plan.table) and len(lines) <= ended else []

    def _require_evidence(self, attempts: list[Attempt]) -> None:
        """Raise an error if evidence that must be measured again has changed."""
        from fieldkit.trial.stored import verification  # noqa: PLC0415 (only a resumed trial has a manifest)

        if differing := verification.differences(self._folder, [attempt.folder for attempt in attempts]):
            raise EvidenceError(
                f"{store.TRIAL_CSV} must be rebuilt, but the evidence has changed since it was measured: "
                f"{verification.summarize(differing)}",
                where=str(self._folder),
                remedy="restore the table and the evidence from a copy, or start a new trial",
            )

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

    def _add_line(self, attempt: Attempt, line: str) -> None:
        self._lines.append(line)
        self._last_numbers[attempt.repeat] = max(attempt.number, self._last_numbers.get(attempt.repeat, 0))
        if not attempt.excused:
            self._counted_attempts[attempt.repeat] += 1
        if attempt.status in {Status.VALID, Status.FAILED}:
            self._finished.add(attempt.repeat)
        self._counts[attempt.status] += 1
