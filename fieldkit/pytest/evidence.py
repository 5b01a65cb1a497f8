"""Evidence of tests: a folder for each test that produces any; by default only folders of failed tests are kept."""

import hashlib
import re
import shutil
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import pytest

from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Event, Finding, Note, PhaseStarted, RepeatEnded, Request
from fieldkit.core.text import sanitized
from fieldkit.pytest import plugin_options
from fieldkit.pytest.plugin_options import Keep

LOG: Final = "lab.log"
"""Log of the lab: commands with their output, faults, places, repeats of trials."""

PROPERTY: Final = "fieldkit_evidence"
"""Property of a failed test in JUnit XML with the path of its folder."""

_SET_UP_NAME: Final = "set-up"
_MAX_NAME_LENGTH: Final = 100
_SECTION: Final = "fieldkit evidence"


class EvidenceFolder:
    """The evidence folder of one test, or of several tests that share a set-up; created when it is first used.

    Attributes:
        has_failed: Whether one of its tests failed.
    """

    def __init__(self, path: Path) -> None:
        self.has_failed = False
        self._requested_path = path
        self._created_path: Path | None = None

    @property
    def path(self) -> Path:
        """The folder, created if necessary.

        Raises:
            ConfigurationError: It cannot be created.
        """
        if self._created_path is None:
            try:
                self._created_path = _new_folder(self._requested_path)
            except OSError as error:
                raise ConfigurationError(
                    f"cannot create the folder for evidence: {error.strerror}",
                    where=str(self._requested_path),
                    remedy="choose another folder with --fieldkit-output",
                ) from error
        return self._created_path

    @property
    def exists(self) -> bool:
        """Whether the folder was created."""
        return self._created_path is not None

    def add(self, text: str) -> None:
        """Add lines to the log; the first has the time of day in UTC.

        Raises:
            ConfigurationError: The folder cannot be created.
            OSError: The log cannot be written.
        """
        lines = "\n".join(map(sanitized, text.splitlines()))  # output of robots may contain control characters
        with (self.path / LOG).open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now(UTC):%H:%M:%S.%f} {lines}\n")

    def remove_unless_kept(self, keep: Keep) -> None:
        """Remove the folder unless it must be kept; content that is added after its removal gets a new folder."""
        if self._created_path is not None and (keep is Keep.NONE or (keep is Keep.FAILED and not self.has_failed)):
            shutil.rmtree(self._created_path, ignore_errors=True)
            with suppress(OSError):  # not empty if other tests have folders in it
                self._created_path.parent.rmdir()
            self._created_path = None


class EvidenceKeeper:
    """Evidence of a run of pytest: of the set-up of each test module, and of each test.

    Args:
        run: Folder for the evidence of the run.
        keep: Which evidence is kept.
    """

    def __init__(self, run: Path, keep: Keep) -> None:
        self._run = run
        self._keep = keep
        self._in_set_up = True
        self._file: Path | None = None
        self._set_up_folder = EvidenceFolder(self._run)
        self._test_folder = EvidenceFolder(self._run)
        self._item: pytest.Item | None = None

    @property
    def folder(self) -> EvidenceFolder:
        """The folder for evidence of the current phase."""
        return self._set_up_folder if self._in_set_up else self._test_folder

    def add_event(self, event: Event) -> None:
        """Add an event of the lab to the log."""
        if line := _line(event):
            self.folder.add(line)

    def begin(self, item: pytest.Item) -> None:
        """Start the evidence of a test."""
        file, _, name = item.nodeid.partition("::")
        file_folder = self._run / _folder_name(file)
        if item.path != self._file:
            self._set_up_folder.remove_unless_kept(self._keep)
            self._file, self._set_up_folder = item.path, EvidenceFolder(file_folder / _SET_UP_NAME)
        self._test_folder = EvidenceFolder(file_folder / _folder_name(name))
        self._item, self._in_set_up = item, True

    def begin_test(self, item: pytest.Item) -> None:
        """Assign later evidence to the test instead of the set-up, which several tests may share."""
        if item is self._item:
            self._in_set_up = False

    def process_report(self, item: pytest.Item, call: pytest.CallInfo[None], report: pytest.TestReport) -> None:
        """Process the report of a phase of a test: add the evidence folders of a failure, clean up after the test."""
        if item is not self._item:
            return
        if report.failed:
            self._test_folder.has_failed = self._set_up_folder.has_failed = True
            _convert_to_lab_error(item, call, report)
            report.sections += [(_SECTION, path) for path in self._kept_folders()]
        if call.when == "teardown":
            report.user_properties += [
                (PROPERTY, path) for path in self._kept_folders() if self._test_folder.has_failed
            ]
            self._test_folder.remove_unless_kept(self._keep)
            self._item, self._in_set_up = None, True

    def end(self) -> None:
        """Clean up the evidence of the last module, and remove empty folders."""
        self._set_up_folder.remove_unless_kept(self._keep)
        for folder in (self._run, self._run.parent):
            with suppress(OSError):
                folder.rmdir()

    def _kept_folders(self) -> list[str]:
        """Return the evidence folders of the running test that are kept."""
        return [
            str(folder.path)
            for folder in (self._test_folder, self._set_up_folder)
            if folder.exists and self._keep is not Keep.NONE
        ]


def _convert_to_lab_error(item: pytest.Item, call: pytest.CallInfo[None], report: pytest.TestReport) -> None:
    """Report a problem of the lab as an error of the set-up, with the message for operators, instead of a failure."""
    if call.excinfo is None or not isinstance(call.excinfo.value, FieldkitError):
        return
    call.excinfo.value.remedy = plugin_options.as_pytest_option(call.excinfo.value.remedy)
    if report.when == "call":
        report.when = "setup"
    if item.config.getoption("tbstyle") == "auto":
        report.longrepr = call.excinfo.getrepr(style="value", chain=False)
        test_entries = [entry for entry in call.excinfo.traceback if Path(entry.path) == item.path]
        if test_entries:
            report.sections.append(("fieldkit", f"requested at {item.location[0]}:{test_entries[-1].lineno + 1}"))


def _line(event: Event) -> str:
    """Return the log text of an event; empty if it is not logged."""
    match event:
        case Note(text):
            return text
        case PhaseStarted(name, repeat):
            return f"{repeat} {name}".strip()
        case RepeatEnded():
            return f"{event.repeat} {event.status}: {event.reason or event.summary}"
        case Finding():
            return f"{event.robot}: {event.check}: {event.status}: {event.detail}"
        case Request(text):
            return f"request to the operator: {text}"
        case _:
            return ""


def _folder_name(text: str) -> str:
    """Return text as the name of a folder; a long text is truncated and a hash is added."""
    name = re.sub(r"[^\w.-]+", "-", text).strip("-.") or "tests"
    if len(name) <= _MAX_NAME_LENGTH:
        return name
    return f"{name[:_MAX_NAME_LENGTH]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _new_folder(requested_path: Path) -> Path:
    """Create a folder; a number is appended to its name if an earlier run of the same test left a folder."""
    path, number = requested_path, 1
    while True:
        with suppress(FileNotFoundError):  # another worker removed the empty parent folder
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.mkdir()
            except FileExistsError:
                number += 1
                path = requested_path.with_name(f"{requested_path.name}-{number}")
            else:
                return path
