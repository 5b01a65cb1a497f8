"""Findings of one robot as they are made; what a robot said enters them here and nowhere else."""

from typing import Final

from fieldkit.core.events import Finding
from fieldkit.core.model import Verdict
from fieldkit.remote.command import printable

LAPTOP: Final = "laptop"
"""Whose findings are those of the machine that fieldkit runs on."""


class Report:
    """Findings on one robot, in order.

    Args:
        robot: Its name.
    """

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.findings: list[Finding] = []

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
        texts = (printable(text.encode()) for text in (check, detail, remedy))
        check, detail, remedy = texts
        self.findings.append(Finding(self.robot, check, status, detail or "no answer", remedy))
