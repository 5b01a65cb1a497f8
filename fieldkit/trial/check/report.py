"""Findings about one robot. Text from a robot is made printable here."""

import re
from dataclasses import dataclass
from typing import Final

from fieldkit.core.events import Finding
from fieldkit.core.model import Verdict
from fieldkit.remote.command import printable

LAPTOP: Final = "laptop"
"""Name under which findings about the machine that runs fieldkit are reported."""


@dataclass(frozen=True)
class UserTools:
    """Permissions and programs with which a robot's user can fix problems.

    Attributes:
        root: True if the user is root.
        programs: Available programs that remedies can use.
    """

    root: bool
    programs: frozenset[str]


class Report:
    """Findings about one robot, in order.

    Args:
        robot: Name of the robot.

    Attributes:
        user_tools: Tools of the robot's user; None while unknown, and for the laptop.
    """

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.findings: list[Finding] = []
        self.user_tools: UserTools | None = None

    def ok(self, check: str, detail: str) -> None:
        """Add a passed check or an observed value."""
        self.add(check, Verdict.OK, detail, "")

    def warn(self, check: str, detail: str, remedy: str) -> None:
        """Add a problem that degrades a trial but does not invalidate it."""
        self.add(check, Verdict.WARN, detail, remedy)

    def fail(self, check: str, detail: str, remedy: str) -> None:
        """Add a problem that prevents a trial."""
        self.add(check, Verdict.FAIL, detail, remedy)

    def add(self, check: str, verdict: Verdict, detail: str, remedy: str) -> None:
        """Add a check with its verdict. The remedy is empty if the check passed."""
        check, detail, remedy = (printable(text.encode()) for text in (check, detail, self._adapted_remedy(remedy)))
        self.findings.append(Finding(self.robot, check, verdict, detail or "no answer", remedy))

    def _adapted_remedy(self, remedy: str) -> str:
        """Adapt a remedy to this robot's user. Remedies of steps are written for Debian and a user with sudo."""
        if self.user_tools is None:
            return remedy
        if "apt-get" not in self.user_tools.programs:
            remedy = _INSTALL.sub(r"install \g<package> (package name in Debian)", remedy)
        if "setcap" not in self.user_tools.programs and _SETCAP.search(remedy):
            remedy += "   # setcap is in Debian's libcap2-bin"
        if self.user_tools.root:
            return _SUDO.sub("", remedy)
        if "sudo" not in self.user_tools.programs and _SUDO.search(remedy):
            return f"as root: {_SUDO.sub('', remedy)}"
        return remedy


_SUDO: Final = re.compile(r"\bsudo (?!-)")  # `sudo` with an option, such as `sudo -u`, is not replaced
_SETCAP: Final = re.compile(r"\bsetcap ")
_INSTALL: Final = re.compile(r"\bsudo apt-get install (?P<package>[a-z0-9.+-]+)")
