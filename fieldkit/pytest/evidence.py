"""Evidence of tests: a folder for each that leaves any, kept where the test failed."""

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
from fieldkit.core.text import harmless
from fieldkit.pytest import options
from fieldkit.pytest.options import Keep

LOG: Final = "lab.log"
"""What happened in the lab, line by line: commands with what they printed, faults, places, repeats of trials."""

PROPERTY: Final = "fieldkit_evidence"
"""Property of a failed test in JUnit XML that names its folder."""

_SHARED: Final = "set-up"
_LONGEST: Final = 100
_SECTION: Final = "fieldkit evidence"


class EvidenceFolder:
    """The folder of one test, or of what several share; made when something is put there.

    Attributes:
        has_failed: Whether a test failed that it is evidence of.
    """

    def __init__(self, path: Path) -> None:
        self.has_failed = False
        self._wanted = path
        self._made: Path | None = None

    @property
    def path(self) -> Path:
        """The folder, which is there now.

        Raises:
            ConfigurationError: It cannot be made.
        """
        if self._made is None:
            try:
                self._made = _new_folder(self._wanted)
            except OSError as error:
                raise ConfigurationError(
                    f"no folder for evidence: {error.strerror}",
                    where=str(self._wanted),
                    remedy="choose another folder by --fieldkit-output",
                ) from error
        return self._made

    @property
    def is_there(self) -> bool:
        """Whether anything was put there."""
        return self._made is not None

    def add(self, text: str) -> None:
        """Add lines to the log, the first with the time of day."""
        lines = "\n".join(map(harmless, text.splitlines()))  # what robots print may be meant for a terminal
        with (self.path / LOG).open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now(UTC):%H:%M:%S.%f} {lines}\n")

    def settle(self, keep: Keep) -> None:
        """Remove it, unless it is to be kept; what it holds later has a new folder."""
        if self._made is not None and (keep is Keep.NONE or (keep is Keep.FAILED and not self.has_failed)):
            shutil.rmtree(self._made, ignore_errors=True)
            with suppress(OSError):  # others have theirs beside it
                self._made.parent.rmdir()
            self._made = None


class EvidenceKeeper:
    """Evidence of a run of pytest: what is set up for a file of tests, and what each test then does.

    Args:
        run: Folder for the evidence of the run.
        keep: Whose evidence is kept.
    """

    def __init__(self, run: Path, keep: Keep) -> None:
        self._run = run
        self._keep = keep
        self._is_shared = True
        self._file: Path | None = None
        self._shared = EvidenceFolder(self._run)
        self._own = EvidenceFolder(self._run)
        self._item: pytest.Item | None = None

    @property
    def folder(self) -> EvidenceFolder:
        """Where evidence of what happens now belongs."""
        return self._shared if self._is_shared else self._own

    def told(self, event: Event) -> None:
        """Take in what happens in the lab."""
        if line := _line(event):
            self.folder.add(line)

    def begin(self, item: pytest.Item) -> None:
        """Begin with a test."""
        file, _, name = item.nodeid.partition("::")
        of_file = self._run / _as_name(file)
        if item.path != self._file:
            self._shared.settle(self._keep)
            self._file, self._shared = item.path, EvidenceFolder(of_file / _SHARED)
        self._own = EvidenceFolder(of_file / _as_name(name))
        self._item, self._is_shared = item, True

    def call(self, item: pytest.Item) -> None:
        """Take what happens from now on as what the test does, and not as set-up, which it may share with others."""
        if item is self._item:
            self._is_shared = False

    def judge(self, item: pytest.Item, call: pytest.CallInfo[None], report: pytest.TestReport) -> None:
        """Take in how a part of a test ended: name the evidence of a failure, or remove it at the test's end."""
        if item is not self._item:
            return
        if report.failed:
            self._own.has_failed = self._shared.has_failed = True
            _as_lab_error(item, call, report)
            report.sections += [(_SECTION, path) for path in self._kept()]
        if call.when == "teardown":
            report.user_properties += [(PROPERTY, path) for path in self._kept() if self._own.has_failed]
            self._own.settle(self._keep)
            self._item, self._is_shared = None, True

    def end(self) -> None:
        """Settle what is left, and remove folders that hold nothing."""
        self._shared.settle(self._keep)
        for folder in (self._run, self._run.parent):
            with suppress(OSError):
                folder.rmdir()

    def _kept(self) -> list[str]:
        """Return the folders of the test that runs, where they are kept."""
        return [
            str(folder.path)
            for folder in (self._own, self._shared)
            if folder.is_there and self._keep is not Keep.NONE
        ]


def _as_lab_error(item: pytest.Item, call: pytest.CallInfo[None], report: pytest.TestReport) -> None:
    """Report what is wrong with the lab as an error of set-up in the words for an operator, and not as a failure."""
    if call.excinfo is None or not isinstance(call.excinfo.value, FieldkitError):
        return
    call.excinfo.value.remedy = options.as_pytest_option(call.excinfo.value.remedy)
    if report.when == "call":
        report.when = "setup"
    if item.config.getoption("tbstyle") == "auto":
        report.longrepr = call.excinfo.getrepr(style="value", chain=False)
        own = [entry for entry in call.excinfo.traceback if Path(entry.path) == item.path]
        if own:
            report.sections.append(("fieldkit", f"asked for at {item.location[0]}:{own[-1].lineno + 1}"))


def _line(event: Event) -> str:
    """Return an event in words for the log; empty for one that needs none there."""
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
            return f"asked to {text}"
        case _:
            return ""


def _as_name(text: str) -> str:
    """Return text as the name of a folder; long ones are cut, and told apart by a sum."""
    name = re.sub(r"[^\w.-]+", "-", text).strip("-.") or "tests"
    if len(name) <= _LONGEST:
        return name
    return f"{name[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _new_folder(wanted: Path) -> Path:
    """Make a folder, with a number behind its name where another try of the same test has left one."""
    path, number = wanted, 1
    while True:
        with suppress(FileNotFoundError):  # another worker removed the one above it, which was empty
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.mkdir()
            except FileExistsError:
                number += 1
                path = wanted.with_name(f"{wanted.name}-{number}")
            else:
                return path
