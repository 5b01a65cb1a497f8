"""Findings of one robot as they are made; what a robot said enters them here and nowhere else."""

import re
from dataclasses import dataclass
from typing import Final

from fieldkit.core.events import Finding
from fieldkit.core.model import Verdict
from fieldkit.remote.command import printable

LAPTOP: Final = "laptop"
"""Whose findings are those of the machine that fieldkit runs on."""


@dataclass(frozen=True)
class Means:
    """Means of a robot's user to mend it.

    Attributes:
        root: Whether the user is root.
        programs: Those of the programs that remedies name and that it has.
    """

    root: bool
    programs: frozenset[str]


class Report:
    """Findings on one robot, in order.

    Args:
        robot: Its name.

    Attributes:
        means: What remedies can be typed there; None while that is not known, and for the laptop.
    """

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.findings: list[Finding] = []
        self.means: Means | None = None

    def ok(self, check: str, detail: str) -> None:
        """Add a check that passed, or something for the record."""
        self.add(check, Verdict.OK, detail, "")

    def warn(self, check: str, detail: str, remedy: str) -> None:
        """Add what makes a trial worse, but not wrong."""
        self.add(check, Verdict.WARN, detail, remedy)

    def fail(self, check: str, detail: str, remedy: str) -> None:
        """Add what no trial can begin with."""
        self.add(check, Verdict.FAIL, detail, remedy)

    def add(self, check: str, status: Verdict, detail: str, remedy: str) -> None:
        """Add a check with its verdict; the remedy is empty where it passed."""
        check, detail, remedy = (printable(text.encode()) for text in (check, detail, self._typable(remedy)))
        self.findings.append(Finding(self.robot, check, status, detail or "no answer", remedy))

    def _typable(self, remedy: str) -> str:
        """Return a remedy as this robot's user can type it: steps word it for Debian and a user who has sudo."""
        if self.means is None:
            return remedy
        if "apt-get" not in self.means.programs:
            remedy = _INSTALL.sub(r"install \g<package> (so called in Debian)", remedy)
        if "setcap" not in self.means.programs and _SETCAP.search(remedy):
            remedy += "   # setcap is of Debian's libcap2-bin"
        if self.means.root:
            return _SUDO.sub("", remedy)
        if "sudo" not in self.means.programs and _SUDO.search(remedy):
            return f"as root: {_SUDO.sub('', remedy)}"
        return remedy


_SUDO: Final = re.compile(r"\bsudo (?!-)")
_SETCAP: Final = re.compile(r"\bsetcap ")
_INSTALL: Final = re.compile(r"\bsudo apt-get install (?P<package>[a-z0-9.+-]+)")
