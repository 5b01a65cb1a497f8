"""One root error, one family per cause; each knows its exit code and what the operator can do about it."""

import difflib
import shlex
from collections.abc import Iterable
from typing import ClassVar


class FieldkitError(Exception):
    """Something went wrong that the operator can understand.

    Args:
        what: What happened, in one sentence without a full stop.
        where: File and line, robot, or repeat concerned; empty when `what` says it.
        remedy: What to do about it, if anything; a command to type where there is one.
    """

    exit_code: ClassVar[int] = 1
    ends_trial: ClassVar[bool] = False
    """Whether going on with the next repeat would be wrong."""

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.remedy = remedy

    @property
    def located(self) -> str:
        """What happened and where, without the remedy."""
        return f"{self.where}: {self.what}" if self.where else self.what

    def __str__(self) -> str:
        return f"{self.located}\n  remedy: {self.remedy}" if self.remedy else self.located


class ConfigurationError(FieldkitError):
    """Usage or configuration: an option, a file, or something missing on this machine."""

    exit_code = 2


class RobotError(FieldkitError):
    """A robot answered, but cannot do what the trial needs."""

    exit_code = 3


class LockLostError(RobotError):
    """Somebody else took the robot, or broke its lock: the trial ends, its repeat is not tried again."""

    ends_trial = True


class MotionHeldError(RobotError):
    """A fault stopped a robot that moves; it must not move before a person [confirms it](motion.md#after-a-fault).

    The trial ends.
    """

    exit_code = 5
    ends_trial = True


class HostKeyError(RobotError):
    """Another machine answers for the robot, or it was reinstalled: nothing goes on until a person has looked."""

    ends_trial = True


class LinkError(FieldkitError):
    """A robot did not answer, or the connection to it broke or ran out of time."""

    exit_code = 3


class LinkLostError(LinkError):
    """The connection broke or could not be made: what was asked may or may not have been done."""


class TestbedLostError(LinkError):
    """A process that the robots need has ended and does not come back: the trial stops, its repeat is redone."""

    ends_trial = True


class EvidenceError(FieldkitError):
    """Evidence is missing, damaged or contradicts itself: a repeat failed, or `verify` found a difference."""

    exit_code = 4


def nearest(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return the remedy for a name that is none of `known`: what was probably meant, or `otherwise`.

    That is every name of which `name` is a whole word, as `rtt` of `rtt_loss`, or the end, behind a step's name,
    as of `up.rtt`; else the one that is most alike, whatever its case.
    """
    names = {one.lower(): one for one in known}
    typed = name.lower()
    near = [one for lower, one in names.items() if typed in lower.split("_") or lower.endswith(f".{typed}")] or [
        names[lower] for lower in difflib.get_close_matches(typed, names, n=1)
    ]
    return f"did you mean {' or '.join(map(repr, near))}?" if near else otherwise


def typed(*words: object) -> str:
    """Return a command as it is typed in a shell, for a remedy: names of files may have blanks."""
    return shlex.join(map(str, words))
