"""The journal of a campaign: the progress of each of its trials, synced to disk before the campaign continues."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Final

from fieldkit.campaign.order import PlannedTrial
from fieldkit.campaign.plan import CAMPAIGN_FILE, CampaignPlan
from fieldkit.config import schema
from fieldkit.config.json_records import Codec
from fieldkit.config.schema import Field
from fieldkit.core import files, jsonl
from fieldkit.trial import store
from fieldkit.trial.plan import PLAN_FILE

JOURNAL_FILE: Final = "journal.jsonl"


class TrialProgress(StrEnum):
    """Progress of a trial."""

    STARTED = "started"
    PLACED = "placed"
    SKIPPED = "skipped"
    ENDED = "ended"


@dataclass(frozen=True)
class CampaignEntry:
    """One line of a campaign's journal.

    Attributes:
        utc_ns: Time of the entry, in nanoseconds since 1970 UTC.
        planned: Name of the trial in campaign.yaml.
        progress: Progress of the trial.
        trial: Name of its folder, if it has one.
        note: Note of the operator.
        took_s: Duration of placing the robots, in seconds; 0 in entries of other progress.
        valid: Number of valid repeats.
        failed: Number of failed repeats.
        unmet: Number of expectations that are not met or undecided.
    """

    utc_ns: int
    planned: Annotated[str, Field(alias="turn")]
    progress: Annotated[TrialProgress, Field(alias="what")]
    trial: Annotated[str, Field(pattern=r"^([0-9A-Za-z][^/\x00]*)?$")] = ""
    note: str = ""
    took_s: float = 0.0
    valid: int = 0
    failed: int = 0
    unmet: int = 0


_CODEC: Final = Codec(CampaignEntry)


class CampaignJournal:
    """The journal of the campaign in a folder; empty if there is none yet.

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
    def locked(self, plan: CampaignPlan) -> Iterator[None]:
        """Lock the campaign against other processes while the body runs, and store its plan on disk if it is missing.

        Raises:
            ConfigurationError: Another process runs the campaign, or the folder cannot be written.
        """
        store.prepare(self.folder)
        with jsonl.locked(self._path, "campaign"):
            jsonl.repair_last_line(self._path, _CODEC.parse)
            self._entries = self._read()
            if not (self.folder / CAMPAIGN_FILE).is_file():
                files.write(self.folder / CAMPAIGN_FILE, schema.dump(plan).encode())
            yield

    def _read(self) -> list[CampaignEntry]:
        if not self._path.is_file():
            return []
        return jsonl.read(self._path, _CODEC.parse, remedy="choose another --out")

    def add(self, planned: PlannedTrial, progress: TrialProgress, **details: Any) -> None:  # noqa: ANN401 (the other fields of CampaignEntry)
        """Record the progress of a trial."""
        entry = CampaignEntry(time.time_ns(), str(planned), progress, **details)
        jsonl.append(self._path, _CODEC.dump(entry))
        self._entries.append(entry)

    def end_entries(self) -> dict[str, CampaignEntry]:
        """Return the last entry of each trial that has ended, by name; trials that were started again are omitted."""
        end_entries: dict[str, CampaignEntry] = {}
        for entry in self._entries:
            if entry.progress is TrialProgress.ENDED:
                end_entries[entry.planned] = entry
            elif entry.progress is TrialProgress.STARTED:
                end_entries.pop(entry.planned, None)
        return end_entries

    def interrupted_folder(self, planned: PlannedTrial) -> Path | None:
        """Return the folder in which a trial was last started, or None if there is nothing to resume.

        The caller must check that the trial has not ended.
        """
        entries = (entry for entry in self._entries if entry.planned == str(planned))
        folder_names = [entry.trial for entry in entries if entry.progress is TrialProgress.STARTED]
        folder = self.folder / folder_names[-1] if folder_names else None
        return folder if folder and (folder / PLAN_FILE).is_file() else None

    def placing_s(self, assumed_s: float) -> float:
        """Return the mean duration of placing robots, or `assumed_s` if robots were never placed."""
        return fmean(
            [entry.took_s for entry in self._entries if entry.progress is TrialProgress.PLACED] or [assumed_s]
        )
