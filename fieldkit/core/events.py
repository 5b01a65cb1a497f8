"""Events of a trial, and the base class of all events, which the display, the log and `--json` receive."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final

from fieldkit.core.model import Status, Verdict

Words = tuple[tuple[str, str], ...]
"""Texts with their styles, in order."""


@dataclass(frozen=True)
class Event:
    """Something that happened during a command.

    `cli.event_words` has the texts of a trial's events. The events of other commands define their texts themselves,
    so that a trial does not import them.
    """

    ends_progress: ClassVar[bool] = False
    """Whether this event ends the work whose progress is shown."""

    @property
    def words(self) -> Words:
        """Displayed texts of an event that does not belong to a trial; empty if the event is not displayed."""
        return ()

    @property
    def part(self) -> str:
        """Part of the work that starts, for example a trial of a campaign; empty for other events."""
        return ""


@dataclass(frozen=True)
class Note(Event):
    """A message for the operator.

    Attributes:
        text: One line.
    """

    text: str


@dataclass(frozen=True)
class Request(Event):
    """The operator must do something; the trial waits for the answer.

    Attributes:
        text: What to do.
        may_skip: Whether it can be postponed.
    """

    text: str
    may_skip: bool


@dataclass(frozen=True)
class Answered(Event):
    """The operator answered the last request.

    Attributes:
        skip: Whether the request is postponed.
        note: Note of the operator; empty if none.
    """

    skip: bool
    note: str


@dataclass(frozen=True)
class Asked(Event):
    """The operator must enter a number or a word; the trial waits for the answer.

    Attributes:
        text: The question.
        how: Description of the possible answers.
    """

    text: str
    how: str


@dataclass(frozen=True)
class Entered(Event):
    """The operator answered the last question.

    Attributes:
        value: The answer.
    """

    value: str


@dataclass(frozen=True)
class Placed(Event):
    """The robots are at their positions of the trial, or the operator postponed placing them.

    Attributes:
        skipped: Whether the placement was postponed.
        note: Note of the operator; empty if none.
        took_s: Duration of the placement.
    """

    skipped: bool
    note: str
    took_s: float


@dataclass(frozen=True)
class PhaseStarted(Event):
    """A phase of work started.

    Attributes:
        name: Name of the phase, for example `record`, `transfer`, `start robots`.
        repeat: The repeat to which it belongs, or empty.
        expected_s: Expected duration; None (`null` in JSON) if unknown.
    """

    name: str
    repeat: str = ""
    expected_s: float | None = None


@dataclass(frozen=True)
class Progress(Event):
    """A computation has made progress.

    Attributes:
        what: Short description of the computation.
        done: Finished amount.
        total: Total amount, above 0.
        unit: Unit of both amounts: `s` of simulated time, `runs`.
        left_s: Estimated remaining time; None (`null` in JSON) if unknown.
    """

    what: str
    done: float
    total: float
    unit: str
    left_s: float | None = None


@dataclass(frozen=True)
class CommandPlanned(Event):
    """A command that a repeat would run, reported by a dry run.

    Attributes:
        protocol: `tcp` or `udp`.
        robot: Name of the robot.
        role: Its role.
        folder: Working directory, relative to the robot's home directory.
        number: 0 for a command that prepares the repeat; then the order of starting, from 1.
        name: Name of the job, for example `record`, or `begin`, `put` or `pack`.
        command: The command line for a shell.
    """

    protocol: str
    robot: str
    role: str
    folder: str
    number: int
    name: str
    command: str


@dataclass(frozen=True)
class Finding(Event):
    """The outcome of one check.

    Attributes:
        robot: Name of the robot, or `laptop`.
        check: Name of the check.
        status: Its outcome.
        detail: Details, in printable characters.
        remedy: What to do, preferably a command; empty if the check passed.
    """

    robot: str
    check: str
    status: Verdict
    detail: str
    remedy: str = ""


NOTHING_ARRIVED: Final = "NOTHING ARRIVED"
"""Start of the summary of a repeat in which all sent data was lost."""


@dataclass(frozen=True)
class RepeatEnded(Event):
    """A repeat ended.

    Attributes:
        repeat: For example `udp-07`.
        attempt: Number of the attempt, from 1.
        status: Valid, void or failed.
        reason: Reason why the repeat is not valid; empty if it is valid.
        summary: Summary of the measured values.
        done: Number of repeats that are finished and not run again.
        total: Number of planned repeats.
        left_s: Estimated remaining time.
        remedy: What to do about a failed step, if the step states it.
        left_most_s: Upper estimate of the remaining time. It does not include repeats that must be run again.
    """

    repeat: str
    attempt: int
    status: Status
    reason: str
    summary: str
    done: int
    total: int
    left_s: float
    remedy: str = ""
    left_most_s: float = 0.0


@dataclass(frozen=True)
class TrialStarted(Event):
    """A trial started or was resumed.

    Attributes:
        folder: Its folder.
        done: Number of repeats that were finished before.
        total: Number of planned repeats.
    """

    folder: str
    done: int
    total: int


@dataclass(frozen=True)
class ExpectationJudged(Event):
    """An expectation of a trial was evaluated for the repeats of one protocol.

    Attributes:
        expectation: The expectation as written in the procedure.
        protocol: Protocol of the repeats; empty if there are no repeats.
        ruling: `holds`, `does not hold` or `undecided`.
        why: Reason for the ruling, if the numbers do not show it; empty otherwise.
        measured: Measured value as text with a unit.
        interval: Its interval or bound as text; empty if there is none.
        n: Number of valid repeats that have the figure.
        n_valid: Number of valid repeats.
        n_censored: Number of repeats among `n` with a right-censored value.
    """

    expectation: str
    protocol: str
    ruling: str
    why: str
    measured: str
    interval: str
    n: int
    n_valid: int
    n_censored: int


@dataclass(frozen=True)
class TrialEnded(Event):
    """The trial is finished; its folder is complete.

    Attributes:
        folder: Its folder.
        valid: Number of valid repeats.
        void: Number of void attempts.
        failed: Number of failed repeats.
    """

    ends_progress = True

    folder: str
    valid: int
    void: int
    failed: int


@dataclass(frozen=True)
class TrialStopped(Event):
    """The trial stopped before its end; `fieldkit resume FOLDER` continues it.

    Attributes:
        folder: Its folder.
        done: Number of finished repeats.
        total: Number of planned repeats.
    """

    ends_progress = True

    folder: str
    done: int
    total: int


Sink = Callable[[Event], None]
"""A function that receives events."""
