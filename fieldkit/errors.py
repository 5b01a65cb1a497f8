"""One root error, one family per cause; each knows its exit code and what the operator can do about it."""

from typing import ClassVar


class FieldkitError(Exception):
    """Something went wrong that the operator can understand.

    Args:
        what: What happened, in one sentence without a full stop.
        where: File and line, robot, or repeat concerned; empty when `what` says it.
        remedy: What to do about it, if anything; a command to type where there is one.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.remedy = remedy

    def __str__(self) -> str:
        located = f"{self.where}: {self.what}" if self.where else self.what
        return f"{located}\n  remedy: {self.remedy}" if self.remedy else located


class ConfigurationError(FieldkitError):
    """A file, option or installation is not what it must be."""

    exit_code = 2


class RobotError(FieldkitError):
    """A robot answered, but cannot do what the trial asks of it."""

    exit_code = 3


class LinkError(FieldkitError):
    """A robot did not answer, or the connection to it broke or ran out of time."""

    exit_code = 3


class EvidenceError(FieldkitError):
    """Raw evidence is missing, damaged or contradicts itself."""

    exit_code = 4
