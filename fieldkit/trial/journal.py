"""The journal: append-only, on disk before anything goes on, the truth about each repeat."""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from fieldkit.errors import EvidenceError
from fieldkit.model import Protocol, RepeatId, Status

JOURNAL_FILE: Final = "journal.jsonl"


@dataclass(frozen=True)
class Entry:
    """One line of the journal.

    Attributes:
        utc_ns: When, in nanoseconds since 1970 UTC.
        protocol: Protocol of the repeat.
        number: Number of the repeat.
        attempt: Number of the attempt, 0 while planned.
        status: What became of it.
        reason: Why it is not valid.
    """

    utc_ns: int
    protocol: Protocol
    number: int
    attempt: int
    status: Status
    reason: str = ""

    @property
    def repeat(self) -> RepeatId:
        """The repeat."""
        return RepeatId(self.protocol, self.number)


@dataclass(frozen=True)
class Attempt:
    """An attempt that ended.

    Attributes:
        repeat: The repeat.
        number: Number of the attempt.
        started_utc_ns: When it began.
        status: How it ended.
        reason: Why it is not valid.
    """

    repeat: RepeatId
    number: int
    started_utc_ns: int
    status: Status
    reason: str

    @property
    def folder(self) -> str:
        """Name of its folder under `repeats/`: `udp-07`, or `udp-07.void1` for one that was redone."""
        return str(self.repeat) if self.status is Status.VALID else f"{self.repeat}.{self.status}{self.number}"


def append(folder: Path, *entries: Entry) -> None:
    """Add entries to the journal of a trial and wait until they are on disk.

    Raises:
        OSError: The disk is full or gone.
    """
    lines = "".join(json.dumps(asdict(entry)) + "\n" for entry in entries)
    descriptor = os.open(folder / JOURNAL_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(descriptor, lines.encode())
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read(folder: Path) -> list[Entry]:
    """Return the entries of a trial's journal; a last line torn by a crash is left out.

    Raises:
        EvidenceError: There is no journal, or a line before the last cannot be read.
    """
    path = folder / JOURNAL_FILE
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise EvidenceError(
            f"no journal: {error.strerror}", where=str(path), remedy="name the folder of a trial"
        ) from error
    entries = []
    for number, line in enumerate(lines, start=1):
        try:
            entries.append(_parse(line))
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines):
                break
            raise EvidenceError(
                "not a journal entry", where=f"{path}:{number}", remedy="restore the file from a copy"
            ) from error
    return entries


def _parse(line: str) -> Entry:
    data = json.loads(line)
    return Entry(
        utc_ns=int(data["utc_ns"]),
        protocol=Protocol(data["protocol"]),
        number=int(data["number"]),
        attempt=int(data["attempt"]),
        status=Status(data["status"]),
        reason=str(data["reason"]),
    )


def ended(entries: list[Entry]) -> list[Attempt]:
    """Return the attempts that ended, in the order in which they ended."""
    started = {(entry.repeat, entry.attempt): entry.utc_ns for entry in entries if entry.status is Status.RUNNING}
    return [
        Attempt(entry.repeat, entry.attempt, started[entry.repeat, entry.attempt], entry.status, entry.reason)
        for entry in entries
        if entry.status not in {Status.PLANNED, Status.RUNNING}
    ]
