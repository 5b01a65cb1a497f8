"""Events of a trial, a campaign or a computation: a stream that display, log and `--json` subscribe to."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Status, Verdict


@dataclass(frozen=True)
class Note:
    """Something that the operator should know.

    Attributes:
        text: One line.
    """

    text: str


@dataclass(frozen=True)
class Request:
    """The operator is asked to do something; nothing goes on before the answer.

    Attributes:
        text: What to do.
        may_skip: Whether it can be left for later.
    """

    text: str
    may_skip: bool


@dataclass(frozen=True)
class Answered:
    """The operator answered the last request.

    Attributes:
        skip: Whether it is left for later.
        note: What was noted.
    """

    skip: bool
    note: str


@dataclass(frozen=True)
class Asked:
    """The operator is asked for a number or a word; nothing goes on before the answer.

    Attributes:
        text: The question.
        how: What can be answered, in words.
    """

    text: str
    how: str


@dataclass(frozen=True)
class Entered:
    """The operator answered the last question.

    Attributes:
        value: The answer.
    """

    value: str


@dataclass(frozen=True)
class Placed:
    """The robots stand where a trial wants them, or the operator left that for later.

    Attributes:
        skipped: Whether it was left.
        note: What the operator noted.
        took_s: How long it took.
    """

    skipped: bool
    note: str
    took_s: float


@dataclass(frozen=True)
class PhaseStarted:
    """A phase of work began.

    Attributes:
        name: For example `record`, `transfer`, `start robots`.
        repeat: The repeat it belongs to, or empty.
        expected_s: How long it should take, None when unknown.
    """

    name: str
    repeat: str = ""
    expected_s: float | None = None


@dataclass(frozen=True)
class Progress:
    """A computation came further.

    Attributes:
        what: What is computed, in a few words.
        done: How much of it is done.
        total: Of how much, above 0.
        unit: What both are counted in: `s` of simulated time, `runs`.
        left_s: Estimated time left, None when unknown.
    """

    what: str
    done: float
    total: float
    unit: str
    left_s: float | None = None


@dataclass(frozen=True)
class CommandPlanned:
    """A dry run came to a command of a repeat.

    Attributes:
        protocol: `tcp` or `udp`.
        robot: Name of the robot.
        role: Its role.
        folder: Where it runs, below the robot's home.
        number: Its place in the order of starting, from 0.
        name: For example `record`.
        command: As a person would type it there.
    """

    protocol: str
    robot: str
    role: str
    folder: str
    number: int
    name: str
    command: str


@dataclass(frozen=True)
class Finding:
    """The outcome of one check.

    Attributes:
        robot: Name of the robot, or `laptop`.
        check: What was looked at.
        status: What it came to.
        detail: What was found, printable.
        remedy: What to do about it, a command to type where there is one; empty when the check passed.
    """

    robot: str
    check: str
    status: Verdict
    detail: str
    remedy: str = ""


NOTHING_ARRIVED: Final = "NOTHING ARRIVED"
"""How the summary of a repeat begins that lost all that it sent."""


@dataclass(frozen=True)
class RepeatEnded:
    """A repeat ended.

    Attributes:
        repeat: For example `udp-07`.
        attempt: 1 for the first try.
        status: Valid, void or failed.
        reason: Why it is not valid; empty when it is.
        summary: What was measured, in a few words.
        done: Repeats finished for good so far.
        total: Repeats planned.
        left_s: Estimated time left.
        remedy: What to do about a step that failed, where the step says it.
        left_most_s: What that may come to, repeats that have to be redone apart.
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
class TrialStarted:
    """A trial began, or is continued.

    Attributes:
        folder: Its folder.
        done: Repeats that were over before.
        total: Repeats planned.
    """

    folder: str
    done: int
    total: int


@dataclass(frozen=True)
class ExpectationJudged:
    """An expectation of a trial was judged by the repeats of one protocol.

    Attributes:
        expectation: As it was written.
        protocol: Of the repeats; empty where there are none.
        ruling: `holds`, `does not hold` or `undecided`.
        why: Why it does not hold, beside the numbers; empty where they say it.
        measured: What was measured, for people.
        interval: Its interval or bound, likewise; empty without one.
        n: Valid repeats that have the figure.
        n_valid: Valid repeats.
        n_censored: Of n, the ones of which only a lower bound is known.
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
class TrialEnded:
    """The trial ended; its folder is complete.

    Attributes:
        folder: Its folder.
        valid: Number of valid repeats.
        void: Number of void attempts.
        failed: Number of failed repeats.
    """

    folder: str
    valid: int
    void: int
    failed: int


@dataclass(frozen=True)
class TrialStopped:
    """The trial stopped before its end; `fieldkit resume FOLDER` continues it.

    Attributes:
        folder: Its folder.
        done: Repeats that are over.
        total: Repeats planned.
    """

    folder: str
    done: int
    total: int


@dataclass(frozen=True)
class CampaignPlanned:
    """What a campaign has to do.

    Attributes:
        name: Its name.
        trials: The trials that are left, in order.
        done: Trials that are over.
        total: All trials.
        walk_m: The way of the robots that are carried, in metres.
        left_s: Estimated time.
        needed_bytes: What their evidence may need on this machine.
        free_bytes: What is free there.
        left_most_s: What `left_s` may come to, repeats that have to be redone apart.
    """

    name: str
    trials: tuple[str, ...]
    done: int
    total: int
    walk_m: float
    left_s: float
    needed_bytes: int
    free_bytes: int
    left_most_s: float = 0.0


@dataclass(frozen=True)
class CampaignTrial:
    """A campaign comes to a trial.

    Attributes:
        trial: Which.
        number: Its number among those that are run, from 1.
        total: All trials.
    """

    trial: str
    number: int
    total: int


@dataclass(frozen=True)
class CampaignWent:
    """A trial of a campaign is over, or was left for later.

    Attributes:
        trial: Which.
        done: Trials that are over.
        total: All trials.
        left_s: Estimated time left.
        left_most_s: What that may come to, repeats that have to be redone apart.
    """

    trial: str
    done: int
    total: int
    left_s: float
    left_most_s: float = 0.0


@dataclass(frozen=True)
class CampaignEnded:
    """The campaign ended or stopped; the same command continues it.

    Attributes:
        folder: Its folder.
        done: Trials that are over.
        total: All trials.
    """

    folder: str
    done: int
    total: int


Event = (
    Note
    | Request
    | Answered
    | Asked
    | Entered
    | Placed
    | PhaseStarted
    | Progress
    | CommandPlanned
    | Finding
    | RepeatEnded
    | TrialStarted
    | ExpectationJudged
    | TrialEnded
    | TrialStopped
    | CampaignPlanned
    | CampaignTrial
    | CampaignWent
    | CampaignEnded
)
Sink = Callable[[Event], None]
