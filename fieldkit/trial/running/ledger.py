"""The ledger of a trial: what became of each attempt, in journal, folders, rows and manifest, on disk at once."""

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
from fieldkit.trial import journal, manifest, rebuild, rows, store
from fieldkit.trial.columns import Row
from fieldkit.trial.journal import Attempt, JournalEntry
from fieldkit.trial.manifest import Manifest
from fieldkit.trial.plan import Plan
from fieldkit.trial.running.stop import Stop

TABLE_SHARE: Final = 0.01
"""Table and manifest are written anew, whole, when so large a share of the attempts is not in them: after each in a
trial of up to 100 attempts, and in a larger one so that all that is written grows as the trial, not as its square."""


class Ledger:
    """Begins and ends attempts; opened on a folder with a past, it knows that too.

    What is in the table is not measured again, and what was summed not summed again.

    Args:
        plan: The trial.
        folder: Its folder.
        stop: Waits until what is being written is whole.

    Raises:
        EvidenceError: The journal is damaged, or evidence that would have to be measured again is not as it was.
    """

    def __init__(self, plan: Plan, folder: Path, stop: Stop) -> None:
        self._plan = plan
        self._folder = folder
        self._stop = stop
        self._lines: list[str] = []
        self._in_table = 0
        self._last: tuple[Attempt, Row] | None = None
        self._numbers: dict[RepeatId, int] = {}
        self._spent: Counter[RepeatId] = Counter()
        self._over: set[RepeatId] = set()
        self._counts: Counter[Status] = Counter()
        journal.mend(folder)
        past = journal.history(folder, plan)
        self._manifest = Manifest(folder)
        if not past:
            now = time.time_ns()
            planned = (
                JournalEntry(now, repeat.protocol, repeat.number, 0, Status.PLANNED) for repeat in plan.order()
            )
            journal.append(folder, *planned)
        ended = journal.ended(past)
        for attempt in ended:
            self._rename(attempt)
        self.differences = dict(self._differing(ended))
        """What is not as it was when it was summed, by file."""
        known = self._known_lines(len(ended))
        remade = [attempt for index, attempt in enumerate(ended) if index >= len(known) or attempt.reopened]
        if remade and self.differences:
            self._demand_evidence(remade)
        for number, attempt in enumerate(ended):
            evidence = store.attempt_folder(folder, attempt.folder)
            is_known = number < len(known) and not attempt.reopened  # its row said that it failed
            row = {} if is_known else rebuild.row(plan, attempt, AttemptEvidence(evidence))
            self._enter(attempt, known[number] if is_known else rows.line(row, self._plan.table))
            if attempt.folder not in self._manifest:
                self._manifest.add(evidence)
        self.ended = tuple(ended)
        """The attempts that had ended before, in the order in which they did."""
        self.cut_short = tuple(journal.cut_short(past))
        """Attempts that fieldkit was killed in; each is to be kept before anything else."""

    @property
    def last(self) -> tuple[Attempt, Row]:
        """The attempt kept last, and its row."""
        assert self._last is not None
        return self._last

    def counts(self, status: Status) -> int:
        """Return how many attempts ended so."""
        return self._counts[status]

    def is_over(self, repeat: RepeatId) -> bool:
        """Return whether a repeat is valid, or failed for good."""
        return repeat in self._over

    @property
    def done(self) -> int:
        """Number of repeats that are over."""
        return len(self._over)

    def is_last(self, repeat: RepeatId) -> bool:
        """Return whether the procedure allows one more attempt at a repeat only."""
        return self._spent[repeat] + 1 >= self._plan.procedure.attempts

    def begin(self, repeat: RepeatId) -> Attempt:
        """Enter a new attempt as running; returns once that is on disk.

        Raises:
            OSError: The disk is full or gone.
        """
        begun = Attempt(repeat, 1 + self._numbers.get(repeat, 0), time.time_ns(), Status.RUNNING)
        self._append(begun, begun.started_utc_ns)
        if self._is_due(len(self._lines) - 1):
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
            final = store.commit_attempt(evidence, attempt.folder)
            ended = replace(attempt, reason=encodable(attempt.reason))
            row = rows.build(self._plan, ended, measured)
            self._append(ended, time.time_ns())
            self._enter(ended, rows.line(row, self._plan.table))
            self._last = ended, row
            self._manifest.add(final)
            if self._is_due(self._in_table):
                self._write()

    def summarize(self) -> tuple[Cell, ...]:
        """Write rows and summary of the attempts kept so far and return the summary; errors as `begin`."""
        with self._stop.whole():
            cells = rows.write_summary(self._folder, self._plan, self._table())
            self._write()
        return cells

    def _rename(self, attempt: Attempt) -> None:
        """Give the folder of an attempt that failed before its repeat was reopened the name of a void one."""
        if not attempt.reopened:
            return
        before = attempt.repeat.folder(Status.FAILED, attempt.number)
        failed, final = (store.attempt_folder(self._folder, name) for name in (before, attempt.folder))
        if failed.is_dir():
            failed.rename(final)
            files.sync_folder(final.parent)
        self._manifest.rename(before, attempt.folder)

    def _is_due(self, in_table: int) -> bool:
        return len(self._lines) - in_table >= TABLE_SHARE * len(self._lines)

    def _write(self) -> None:
        rows.write_table(self._folder, self._table())
        self._manifest.write()
        self._in_table = len(self._lines)

    def _table(self) -> str:
        return rows.head(self._plan.table) + "".join(self._lines)

    def _differing(self, ended: list[Attempt]) -> Iterator[tuple[str, str]]:
        if ended and not (self._folder / store.MANIFEST_FILE).exists():
            yield store.MANIFEST_FILE, "missing, so nothing says whether evidence is as it was"
        if self._manifest.unchanged_lines(store.TRIAL_CSV) is None:
            yield store.TRIAL_CSV, "changed"
        yield from manifest.differences(self._folder).items()

    def _known_lines(self, ended: int) -> list[str]:
        """Return the lines of the table that are as they were summed, for so many attempts at most."""
        whole = self._manifest.unchanged_lines(store.TRIAL_CSV)
        if not whole:
            return []
        text = files.read(self._folder / store.TRIAL_CSV).decode()
        head, *lines = text.splitlines(keepends=True)[:whole]
        return lines if head == rows.head(self._plan.table) and len(lines) <= ended else []

    def _demand_evidence(self, attempts: list[Attempt]) -> None:
        """Refuse to measure again what is not as it was summed."""
        if differing := manifest.differences(self._folder, [attempt.folder for attempt in attempts]):
            raise EvidenceError(
                f"{store.TRIAL_CSV} has to be made again, and evidence is not what was measured: "
                f"{manifest.few(differing)}",
                where=str(self._folder),
                remedy="restore both from a copy, or start a new trial",
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

    def _enter(self, attempt: Attempt, line: str) -> None:
        self._lines.append(line)
        self._numbers[attempt.repeat] = max(attempt.number, self._numbers.get(attempt.repeat, 0))
        self._spent[attempt.repeat] += not attempt.excused
        self._over |= {attempt.repeat} if attempt.status in {Status.VALID, Status.FAILED} else set()
        self._counts[attempt.status] += 1
