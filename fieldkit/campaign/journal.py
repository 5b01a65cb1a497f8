"""What became of each trial of a campaign: a journal that is on disk before anything goes on."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from statistics import fmean
from typing import Any, Final

from fieldkit.campaign.file import Turn
from fieldkit.campaign.frozen import FROZEN_FILE, Frozen
from fieldkit.config import schema
from fieldkit.core import files, jsonl
from fieldkit.trial import store
from fieldkit.trial.plan import PLAN_FILE

JOURNAL_FILE: Final = "journal.jsonl"


class What(StrEnum):
    """What happened to a trial."""

    STARTED = "started"
    PLACED = "placed"
    SKIPPED = "skipped"
    ENDED = "ended"


@dataclass(frozen=True)
class Entry:
    """One line of a campaign's journal.

    Attributes:
        utc_ns: When, in nanoseconds since 1970 UTC.
        turn: Which trial, as campaign.yaml calls it.
        what: What happened.
        trial: Name of its folder, once it has one.
        note: What the operator noted.
        took_s: How long placing took, in seconds.
        valid: Repeats that ended valid.
        failed: Repeats that failed.
    """

    utc_ns: int
    turn: str
    what: What
    trial: str = ""
    note: str = ""
    took_s: float = 0.0
    valid: int = 0
    failed: int = 0


class Book:
    """The journal of the campaign in a folder; empty where there is none yet.

    Args:
        folder: The campaign's folder.

    Raises:
        EvidenceError: The journal is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / JOURNAL_FILE
        self._entries = self._read()

    @contextmanager
    def kept(self, inputs: Frozen) -> Iterator[None]:
        """Keep the book on disk while the body runs, and every other fieldkit off it.

        Raises:
            ConfigurationError: Another one has it, or the folder cannot be written.
        """
        store.prepare(self.folder)
        with jsonl.claimed(self._path, "campaign"):
            jsonl.mend(self._path, _parse)
            self._entries = self._read()
            if not (self.folder / FROZEN_FILE).is_file():
                files.write(self.folder / FROZEN_FILE, schema.dump(inputs).encode())
            yield

    def _read(self) -> list[Entry]:
        if not self._path.is_file():
            return []
        return jsonl.read(self._path, _parse, remedy="choose another --out")

    def add(self, turn: Turn, what: What, **details: Any) -> None:  # noqa: ANN401 (the other fields of Entry)
        """Enter what happened to a trial."""
        entry = Entry(time.time_ns(), str(turn), what, **details)
        jsonl.append(self._path, asdict(entry))
        self._entries.append(entry)

    def ended(self) -> dict[str, Entry]:
        """Return the last entry of each trial that is over."""
        return {entry.turn: entry for entry in self._entries if entry.what is What.ENDED}

    def interrupted(self, turn: Turn) -> Path | None:
        """Return the folder that a trial which is not over began in, None where there is nothing to go on with."""
        started = [one.trial for one in self._entries if one.turn == str(turn) and one.what is What.STARTED]
        folder = self.folder / started[-1] if started else None
        return folder if folder and (folder / PLAN_FILE).is_file() else None

    def placing_s(self, assumed_s: float) -> float:
        """Return how long it takes to place robots, from the times so far; `assumed_s` before the first."""
        return fmean([one.took_s for one in self._entries if one.what is What.PLACED] or [assumed_s])


def _parse(data: Any) -> Entry:  # noqa: ANN401 (any JSON value)
    return Entry(
        utc_ns=int(data["utc_ns"]),
        turn=str(data["turn"]),
        what=What(data["what"]),
        trial=str(data["trial"]),
        note=str(data["note"]),
        took_s=float(data["took_s"]),
        valid=int(data["valid"]),
        failed=int(data["failed"]),
    )
