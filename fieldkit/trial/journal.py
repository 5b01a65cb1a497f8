"""The journal of a trial: an append-only record of its repeats, synced to disk before the trial continues."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from fieldkit.config.json_records import Codec
from fieldkit.config.schema import Field
from fieldkit.core import jsonl, laptop_files
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FINAL_STATUSES, Protocol, RepeatId, Status
from fieldkit.remote import jobs
from fieldkit.trial.plan import Plan

JOURNAL_FILE: Final = laptop_files.JOURNAL

_OPEN_STATUSES: Final = frozenset({Status.PLANNED, Status.RUNNING, Status.MEASURED})


@dataclass(frozen=True)
class JournalEntry:
    """One line of the journal.

    Attributes:
        utc_ns: Time of the entry, in nanoseconds since 1970 UTC.
        protocol: Protocol of the repeat.
        number: Number of the repeat.
        attempt: Number of the attempt; 0 while the repeat is planned.
        status: Status of the repeat or attempt.
        reason: Reason why the attempt is not valid.
        excused: True if the attempt was interrupted, for example by the operator, and therefore does not count as one
            of the allowed attempts.
    """

    utc_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    protocol: Protocol
    number: Annotated[int, Field(ge=1, lt=1 << 31)]
    attempt: Annotated[int, Field(ge=0, lt=1 << 31)]
    status: Status
    reason: str = ""
    excused: bool = False

    @property
    def repeat(self) -> RepeatId:
        """The repeat."""
        return RepeatId(self.protocol, self.number)


_CODEC: Final = Codec(JournalEntry)


@dataclass(frozen=True)
class Attempt:
    """One attempt at a repeat.

    Attributes:
        repeat: The repeat.
        number: Number of the attempt.
        started_utc_ns: Start, nanoseconds since 1970 UTC.
        status: Final status, or `running` or `measured` if the attempt has not ended.
        reason: Reason why the attempt is not valid.
        excused: True if the attempt does not count as one of the allowed attempts, because it was interrupted or its
            repeat was reopened later.
        reopened: True if the attempt failed and its repeat was reopened later (`reopen_failed`). The attempt is then
            void.
    """

    repeat: RepeatId
    number: int
    started_utc_ns: int
    status: Status
    reason: str = ""
    excused: bool = False
    reopened: bool = False

    @property
    def folder(self) -> str:
        """Name of the attempt's folder in `repeats/`: `udp-07` if it is valid, otherwise such as `udp-07.void1`."""
        return self.repeat.folder(self.status, self.number)

    def remote_folder(self, trial: str) -> str:
        """Return the attempt's folder on each robot."""
        return jobs.work_folder(trial, f"{self.repeat}-{self.number}")

    @property
    def folders(self) -> tuple[str, ...]:
        """All names that the folder may have, depending on the final status."""
        return tuple(self.repeat.folder(status, self.number) for status in FINAL_STATUSES)


def locked(folder: Path) -> AbstractContextManager[None]:
    """Return a context manager that locks a trial against other processes of fieldkit.

    Raises the same errors as `jsonl.locked`.
    """
    return jsonl.locked(folder / JOURNAL_FILE, "trial")


def append(folder: Path, *entries: JournalEntry) -> None:
    """Add entries to the journal of a trial. Raises the same errors as `jsonl.append`."""
    jsonl.append(folder / JOURNAL_FILE, *map(_CODEC.dump, entries))


def reopen_failed(folder: Path, plan: Plan) -> int:
    """Plan every failed repeat of a locked trial again, and return the number of these repeats.

    `ended_attempts` then returns the failed attempts as void.

    Raises:
        EvidenceError: For the same reasons as `history`.
        OSError: The disk is full or was removed.
    """
    remove_torn_line(folder)
    now = time.time_ns()
    failed_repeats = [
        attempt.repeat for attempt in ended_attempts(history(folder, plan)) if attempt.status is Status.FAILED
    ]
    append(
        folder, *(JournalEntry(now, repeat.protocol, repeat.number, 0, Status.PLANNED) for repeat in failed_repeats)
    )
    return len(failed_repeats)


def remove_torn_line(folder: Path) -> None:
    """Remove the last line of the journal if a crash left it incomplete; see `jsonl.repair_last_line`."""
    jsonl.repair_last_line(folder / JOURNAL_FILE, _CODEC.parse)


def read(folder: Path) -> list[JournalEntry]:
    """Return the entries of a trial's journal. Raises the same errors as `jsonl.read`."""
    return jsonl.read(folder / JOURNAL_FILE, _CODEC.parse, remedy="name the folder of a trial")


def started_attempts(folder: Path) -> int:
    """Return the number of attempts that have started in a trial; 0 if its journal is missing or damaged."""
    try:
        entries = read(folder)
    except EvidenceError:
        return 0
    return sum(entry.status is Status.RUNNING for entry in entries)


def history(folder: Path, plan: Plan) -> list[JournalEntry]:
    """Return the entries of a trial's journal after a check that their sequence is possible.

    Raises:
        EvidenceError: For the same reasons as `read`, or because an entry contradicts earlier entries, or because
            its repeat is not in the plan.
    """
    entries = read(folder)
    for line, reason in _impossible_entries(entries, plan):
        raise EvidenceError(
            f"impossible entry: {reason}",
            where=f"{folder / JOURNAL_FILE}:{line}",
            remedy="restore the file from a copy",
        )
    return entries


def _impossible_entries(entries: list[JournalEntry], plan: Plan) -> Iterator[tuple[int, str]]:
    """Yield the line number of each entry that contradicts the plan or an earlier entry, and the reason."""
    started: set[tuple[RepeatId, int]] = set()
    ended: set[tuple[RepeatId, int]] = set()
    final_status: dict[RepeatId, Status] = {}
    for line, entry in enumerate(entries, start=1):
        repeat, attempt = entry.repeat, (entry.repeat, entry.attempt)
        if repeat.protocol not in plan.protocols or repeat.number > plan.repeats:
            yield line, f"the plan has no repeat {repeat}"
        elif entry.status is Status.PLANNED:
            # A failed repeat may be planned again. A repeat without a final status is planned for the first time.
            if final_status.pop(repeat, Status.FAILED) is not Status.FAILED:
                yield line, f"{repeat} is planned again, although it was valid"
        elif entry.status is Status.RUNNING:
            if attempt in started or repeat in final_status or not entry.attempt:
                yield line, f"attempt {entry.attempt} at {repeat} starts, although it or its repeat has ended"
            started.add(attempt)
        elif attempt not in started or attempt in ended:
            yield line, f"attempt {entry.attempt} at {repeat} is {entry.status}, although it is not running"
        elif entry.status in FINAL_STATUSES:
            ended.add(attempt)
            if entry.status is not Status.VOID:
                final_status[repeat] = entry.status


def ended_attempts(entries: list[JournalEntry]) -> list[Attempt]:
    """Return the attempts that ended, in the order of their ends. Failed attempts of a reopened repeat are void."""
    start_ns_by_attempt = {
        (entry.repeat, entry.attempt): entry.utc_ns for entry in entries if entry.status is Status.RUNNING
    }
    planned_at = {entry.repeat: line for line, entry in enumerate(entries) if entry.status is Status.PLANNED}

    def to_attempt(entry: JournalEntry, *, is_before_reopening: bool) -> Attempt:
        reopened = is_before_reopening and entry.status is Status.FAILED
        return Attempt(
            repeat=entry.repeat,
            number=entry.attempt,
            started_utc_ns=start_ns_by_attempt[entry.repeat, entry.attempt],
            status=Status.VOID if reopened else entry.status,
            reason=entry.reason,
            excused=entry.excused or is_before_reopening,
            reopened=reopened,
        )

    return [
        to_attempt(entry, is_before_reopening=line < planned_at.get(entry.repeat, -1))
        for line, entry in enumerate(entries)
        if entry.status not in _OPEN_STATUSES
    ]


def interrupted_attempts(entries: list[JournalEntry]) -> list[Attempt]:
    """Return the attempts that have not ended, because fieldkit was killed or is still running.

    Their status is `running` or `measured`.
    """
    ended_keys = {(attempt.repeat, attempt.number) for attempt in ended_attempts(entries)}
    start_ns_by_attempt = {
        (entry.repeat, entry.attempt): entry.utc_ns
        for entry in entries
        if entry.status is Status.RUNNING and (entry.repeat, entry.attempt) not in ended_keys
    }
    measured_keys = {(entry.repeat, entry.attempt) for entry in entries if entry.status is Status.MEASURED}
    return [
        Attempt(repeat, number, utc_ns, Status.MEASURED if (repeat, number) in measured_keys else Status.RUNNING)
        for (repeat, number), utc_ns in start_ns_by_attempt.items()
    ]
