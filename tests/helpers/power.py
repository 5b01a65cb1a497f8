"""Compares the files that fieldkit had reported to the user before a power cut with the disk after the cut."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.core.events import Event, Note, RepeatEnded, TrialEnded
from fieldkit.core.model import Status
from fieldkit.trial import journal
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.running.resumption import resume_trial
from tests.helpers.disks import Disk
from tests.helpers.idle_testbed import IdleTestbed
from tests.trial.test_trial_crash import VOID_FIRST, assert_complete, trial_of

_MANIFEST: Final = "MANIFEST.sha256"


@dataclass
class VersionRecorder:
    """Records all versions of the files with a final name, and the version of each file at the last report to the
    user.

    Args:
        folder: Folder of the trials; must exist before the first `record_versions`.
    """

    folder: Path
    versions: dict[str, list[bytes]] = field(default_factory=dict)
    reported: dict[str, int] = field(default_factory=dict)
    is_over: bool = False

    def record_versions(self) -> None:
        """Record the present versions of all files."""
        for name, content in final_files(self.folder).items():
            versions = self.versions.setdefault(name, [])
            if not versions or versions[-1] != content:
                versions.append(content)

    def on_event(self, event: Event) -> None:
        """Record the present versions if an event reports completed work to the user."""
        if isinstance(event, Note | RepeatEnded | TrialEnded):
            self.record_versions()
            self.reported |= {name: len(versions) - 1 for name, versions in self.versions.items()}
            self.is_over = isinstance(event, TrialEnded)


@dataclass(frozen=True)
class PowerCut:
    """A power cut.

    Attributes:
        disk: The disk after the cut.
        reported: For each file, the version at the last report to the user.
        is_over: True if the end of the trial had been reported.
        description: Description of the time of the cut.
    """

    disk: Disk
    reported: dict[str, int]
    is_over: bool
    description: str

    def lost_files(self, folder: Path, recorder: VersionRecorder) -> list[str]:
        """Descriptions of the files that are missing, old or incomplete on the disk after the cut.

        Args:
            folder: Folder of the trials on the repaired and mounted disk.
            recorder: The recorder of the interrupted trial.
        """
        remaining = final_files(folder)
        problems = [
            f"{self.description}: {name} is {'older than reported' if name in remaining else 'missing'}"
            for name, number in self.reported.items()
            if not _is_current(
                remaining.get(name), recorder.versions[name][number:], grows=name.endswith(JOURNAL_FILE)
            )
        ]
        problems += [
            f"{self.description}: {name} is incomplete"
            for name, content in remaining.items()
            if not name.endswith(JOURNAL_FILE) and content not in recorder.versions.get(name, [])
        ]
        return problems + [f"{self.description}: {problem}" for problem in _lost_evidence(folder, recorder)]


def read_tree(folder: Path) -> dict[str, bytes | None]:
    """The content of each file below a folder, and None for each subfolder."""
    paths = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    return {name: path.read_bytes() if path.is_file() else None for name, path in paths.items()}


def final_files(folder: Path) -> dict[str, bytes]:
    """The content of each file below a folder, without temporary files."""
    entries = read_tree(folder).items()
    return {name: content for name, content in entries if "/." not in f"/{name}" and content is not None}


def _is_current(content: bytes | None, versions: list[bytes], *, grows: bool) -> bool:
    """Return True if the content is the reported version or a later one; a journal may also be longer."""
    if content is None:
        return False
    reported = versions[0]
    return content.startswith(reported[: reported.rfind(b"\n") + 1]) if grows else content in versions


def _lost_evidence(folder: Path, recorder: VersionRecorder) -> Iterator[str]:
    """Yield differences between the evidence of completed attempts and the journal or the manifest."""
    remaining = final_files(folder)
    for path in folder.glob(f"*/{JOURNAL_FILE}"):
        try:
            entries = journal.ended_attempts(journal.read(path.parent))
        except EvidenceError as error:
            yield error.what
            continue
        for attempt in entries:
            attempt_folder = path.parent / "repeats" / attempt.folder
            prefix = f"{attempt_folder.relative_to(folder).as_posix()}/"
            expected = {name: content[-1] for name, content in recorder.versions.items() if name.startswith(prefix)}
            if not attempt_folder.is_dir() or expected != {
                name: remaining[name] for name in remaining if name.startswith(prefix)
            }:
                yield f"the evidence of {attempt.folder} does not match its journal line"
    for manifest in [name for name in remaining if name.endswith(f"/{_MANIFEST}")]:
        for digest, name in (line.split("  ", 1) for line in remaining[manifest].decode().splitlines()):
            content = remaining.get(manifest.replace(_MANIFEST, name))
            if name.startswith("repeats/") and (content is None or hashlib.sha256(content).hexdigest() != digest):
                yield f"{name} does not match the manifest"


def assert_resumable(out: Path) -> None:
    """Resume a trial after a cut; it must be completed and keep all attempts that had ended or were measured."""
    folder = trial_of(out)
    entries = journal.read(folder) if (folder / JOURNAL_FILE).is_file() else []
    before, evidence = journal.ended_attempts(entries), final_files(folder / "repeats")
    measured = [attempt for attempt in journal.interrupted_attempts(entries) if attempt.status is Status.MEASURED]
    resume_trial(folder, IdleTestbed(), lambda _: None)
    assert_complete(out)
    after = journal.ended_attempts(journal.read(folder))
    assert after[: len(before)] == before
    assert evidence.items() <= final_files(folder / "repeats").items()
    is_valid = {(attempt.repeat, attempt.number): attempt.status is Status.VALID for attempt in after}
    for attempt in measured:
        assert is_valid[attempt.repeat, attempt.number] == (
            not VOID_FIRST.endswith(f"{attempt.repeat}-{attempt.number}")
        ), attempt
