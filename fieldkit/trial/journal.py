"""The journal: append-only, on disk before anything goes on, the truth about each repeat."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.config.schema import Codec
from fieldkit.core import jsonl
from fieldkit.core.model import ENDED, Protocol, RepeatId, Status

JOURNAL_FILE: Final = "journal.jsonl"

_OPEN: Final = frozenset({Status.PLANNED, Status.RUNNING, Status.MEASURED})


@dataclass(frozen=True)
class JournalEntry:
    """One line of the journal.

    Attributes:
        utc_ns: When, in nanoseconds since 1970 UTC.
        protocol: Protocol of the repeat.
        number: Number of the repeat.
        attempt: Number of the attempt, 0 while planned.
        status: What became of it.
        reason: Why it is not valid.
        excused: Whether it was cut short from outside, so that it counts for nothing but its record.
    """

    utc_ns: int
    protocol: Protocol
    number: int
    attempt: int
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
    """An attempt that ended.

    Attributes:
        repeat: The repeat.
        number: Number of the attempt.
        started_utc_ns: When it began.
        status: How it ended.
        reason: Why it is not valid.
        excused: Whether it was cut short from outside, so that it is none of the attempts that the procedure allows.
    """

    repeat: RepeatId
    number: int
    started_utc_ns: int
    status: Status
    reason: str = ""
    excused: bool = False

    @property
    def folder(self) -> str:
        """Name of its folder under `repeats/`: `udp-07`, or `udp-07.void1` for one that was redone."""
        return self.repeat.folder(self.status, self.number)

    @property
    def folders(self) -> tuple[str, ...]:
        """Every name that its folder may get, however it ends."""
        return tuple(self.repeat.folder(status, self.number) for status in ENDED)


def claimed(folder: Path) -> AbstractContextManager[None]:
    """Keep every other fieldkit off a trial; raises as `jsonl.claimed`."""
    return jsonl.claimed(folder / JOURNAL_FILE, "trial")


def append(folder: Path, *entries: JournalEntry) -> None:
    """Add entries to the journal of a trial; raises as `jsonl.append`."""
    jsonl.append(folder / JOURNAL_FILE, *map(_CODEC.dump, entries))


def mend(folder: Path) -> None:
    """Take off a last line that a crash has torn; see `jsonl.mend`."""
    jsonl.mend(folder / JOURNAL_FILE, _CODEC.parse)


def read(folder: Path) -> list[JournalEntry]:
    """Return the entries of a trial's journal; raises as `jsonl.read`."""
    return jsonl.read(folder / JOURNAL_FILE, _CODEC.parse, remedy="name the folder of a trial")


def ended(entries: list[JournalEntry]) -> list[Attempt]:
    """Return the attempts that ended, in the order in which they ended."""
    started = {(entry.repeat, entry.attempt): entry.utc_ns for entry in entries if entry.status is Status.RUNNING}
    return [
        Attempt(
            repeat=entry.repeat,
            number=entry.attempt,
            started_utc_ns=started[entry.repeat, entry.attempt],
            status=entry.status,
            reason=entry.reason,
            excused=entry.excused,
        )
        for entry in entries
        if entry.status not in _OPEN
    ]


def cut_short(entries: list[JournalEntry]) -> list[Attempt]:
    """Return the attempts that began and never ended, `running` or `measured`: fieldkit was killed meanwhile."""
    over = {(attempt.repeat, attempt.number) for attempt in ended(entries)}
    begun = {
        (entry.repeat, entry.attempt): entry.utc_ns
        for entry in entries
        if entry.status is Status.RUNNING and (entry.repeat, entry.attempt) not in over
    }
    measured = {(entry.repeat, entry.attempt) for entry in entries if entry.status is Status.MEASURED}
    return [
        Attempt(repeat, number, utc_ns, Status.MEASURED if (repeat, number) in measured else Status.RUNNING)
        for (repeat, number), utc_ns in begun.items()
    ]
