"""Errors for the operator: one base class and one subclass per cause, each with an exit code and a remedy."""

import difflib
import shlex
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, Final

_PACKAGES: Final = (Path(__file__).parents[1], Path(__file__).parents[2] / "sim_backends")


class FieldkitError(Exception):
    """Base class of all errors that are shown to the operator without a traceback.

    Args:
        what: What happened, in one sentence without a full stop.
        where: File and line, robot, or repeat; empty if `what` contains it.
        remedy: What the operator can do, if anything; preferably a command.
    """

    exit_code: ClassVar[int] = 1
    ends_trial: ClassVar[bool] = False
    """Whether the trial must stop, instead of continuing with the next repeat."""

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
    """Error in an option, a file, or the setup of this machine."""

    exit_code = 2


class RobotError(FieldkitError):
    """A robot answered, but cannot do what the trial needs."""

    exit_code = 3


class LockLostError(RobotError):
    """Another user locked the robot or broke its lock: the trial ends, and the repeat is not retried."""

    ends_trial = True


class MotionHeldError(RobotError):
    """A fault stopped a robot that moves; it must not move before a person [confirms it](motion.md#after-a-fault).

    The trial ends.
    """

    exit_code = 5
    ends_trial = True


class HostKeyError(RobotError):
    """The robot's SSH host key differs from the pinned key; a person must check it.

    The key changes if another machine has the address, or after a new installation.
    """

    ends_trial = True


class LinkError(FieldkitError):
    """A robot did not answer, or its connection was lost or timed out."""

    exit_code = 3


class LinkLostError(LinkError):
    """The connection broke or could not be opened: the requested action may or may not have happened."""


class TestbedLostError(LinkError):
    """A process that the robots need has exited permanently. The trial stops; `resume` runs the repeat again."""

    ends_trial = True


class EvidenceError(FieldkitError):
    """Evidence is missing, damaged or contradicts itself: a repeat failed, or `verify` found a difference."""

    exit_code = 4


def describe_exception(error: BaseException) -> str:
    """Return an exception in one line with the place in the code: `KeyError: 'a' (hops_step.py, line 28)`.

    The place is the last traceback entry in the outermost file that is not part of this distribution. This file can
    be a step or policy of another package, which may call a library that raises the error. If there is no such file,
    the place is the last entry of the traceback.
    """
    first_line = next(iter(str(error).splitlines()), "")
    text = type(error).__name__ + (f": {first_line}" if first_line else "")
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return text
    outside_frames = [frame for frame in frames if not any(map(Path(frame.filename).is_relative_to, _PACKAGES))]
    place = next(
        (frame for frame in reversed(outside_frames) if frame.filename == outside_frames[0].filename), frames[-1]
    )
    return f"{text} ({Path(place.filename).name}, line {place.lineno})"


def did_you_mean(name: str, candidates: Iterable[str], otherwise: str) -> str:
    """Return the remedy for an unknown name: `did you mean 'rtt_loss'?`, or `otherwise` if no known name is similar.

    A name is similar if it contains `name` as a whole word (`rtt_loss` contains `rtt`), or if it is `name` with the
    name of a step as prefix (`up.rtt`). If there is no such name, the closest match is used. Case is ignored.
    """
    names = {candidate.lower(): candidate for candidate in candidates}
    lower_name = name.lower()
    matches = [
        candidate
        for lower, candidate in names.items()
        if lower_name in lower.split("_") or lower.endswith(f".{lower_name}")
    ] or [names[lower] for lower in difflib.get_close_matches(lower_name, names, n=1)]
    return f"did you mean {' or '.join(map(repr, matches))}?" if matches else otherwise


def shell_command(*words: object) -> str:
    """Return a command line with shell quoting, for a remedy; file names may contain blanks."""
    return shlex.join(map(str, words))
