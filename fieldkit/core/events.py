"""Events of a trial, a campaign or a computation, which the display, the log and `--json` receive."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Status, Verdict


@dataclass(frozen=True)
class Note:
    """A message for the operator.

    Attributes:
        text: One line.
    """

    text: str


@dataclass(frozen=True)
class Request:
    """The operator must do something; the trial waits for the answer.

    Attributes:
        text: What to do.
        may_skip: Whether it can be postponed.
    """

    text: str
    may_skip: bool


@dataclass(frozen=True)
class Answered:
    """The operator answered the last request.

    Attributes:
        skip: Whether it is postponed.
        note: Note of the operator; empty if none.
    """

    skip: bool
    note: str


@dataclass(frozen=True)
class Asked:
    """The operator must enter a number or a word; the trial waits for the answer.

    Attributes:
        text: The question.
        how: Description of the possible answers.
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
    """The robots are at their positions of the trial, or the operator postponed placing them.

    Attributes:
        skipped: Whether it was postponed.
        note: Note of the operator; empty if none.
        took_s: Duration of the placement.
    """

    skipped: bool
    note: str
    took_s: float


@dataclass(frozen=True)
class PhaseStarted:
    """A phase of work started.

    Attributes:
        name: For example `record`, `transfer`, `start robots`.
        repeat: The repeat to which it belongs, or empty.
        expected_s: Expected duration; None if unknown.
    """

    name: str
    repeat: str = ""
    expected_s: float | None = None


@dataclass(frozen=True)
class Progress:
    """A computation has made progress.

    Attributes:
        what: Short description of the computation.
        done: Finished amount.
        total: Total amount, above 0.
        unit: Unit of both amounts: `s` of simulated time, `runs`.
        left_s: Estimated remaining time; None if unknown.
    """

    what: str
    done: float
    total: float
    unit: str
    left_s: float | None = None


@dataclass(frozen=True)
class CommandPlanned:
    """A command that a repeat would run, reported by a dry run.

    Attributes:
        protocol: `tcp` or `udp`.
        robot: Name of the robot.
        role: Its role.
        folder: Working directory, relative to the robot's home directory.
        number: Index in the order of starting, from 0.
        name: Name of the job, for example `record`.
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
class Finding:
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
class RepeatEnded:
    """A repeat ended.

    Attributes:
        repeat: For example `udp-07`.
        attempt: Number of the attempt, from 1.
        status: Valid, void or failed.
        reason: Why it is not valid; empty if it is.
        summary: Summary of the measured values.
        done: Number of repeats that are finished and not run again.
        total: Number of planned repeats.
        left_s: Estimated remaining time.
        remedy: What to do about a failed step, if the step states it.
        left_most_s: Upper estimate of the remaining time, without repeats that must be run again.
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
class ExpectationJudged:
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
class TrialEnded:
    """The trial is finished; its folder is complete.

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
        done: Number of finished repeats.
        total: Number of planned repeats.
    """

    folder: str
    done: int
    total: int


@dataclass(frozen=True)
class CampaignPlanned:
    """The remaining work of a campaign.

    Attributes:
        name: Its name.
        trials: The remaining trials, in order.
        done: Number of finished trials.
        total: Number of all trials.
        walk_m: Distance for which robots must be carried, in metres.
        left_s: Estimated time.
        needed_bytes: Disk space on this machine that the evidence may need.
        free_bytes: Free disk space on this machine.
        left_most_s: Upper estimate of `left_s`, without repeats that must be run again.
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
    """A campaign starts a trial.

    Attributes:
        trial: Name of the trial.
        number: Its number among the trials that are run, from 1.
        total: Number of all trials.
    """

    trial: str
    number: int
    total: int


@dataclass(frozen=True)
class CampaignWent:
    """A trial of a campaign is finished, or was postponed.

    Attributes:
        trial: Name of the trial.
        done: Number of finished trials.
        total: Number of all trials.
        left_s: Estimated remaining time.
        left_most_s: Upper estimate of the remaining time, without repeats that must be run again.
    """

    trial: str
    done: int
    total: int
    left_s: float
    left_most_s: float = 0.0


@dataclass(frozen=True)
class CampaignEnded:
    """The campaign is finished or was stopped; the same command continues it.

    Attributes:
        folder: Its folder.
        done: Number of finished trials.
        total: Number of all trials.
    """

    folder: str
    done: int
    total: int


@dataclass(frozen=True)
class SweepPlanned:
    """A sweep of simulations starts or continues.

    Attributes:
        folder: Its folder.
        done: Number of runs that were finished before.
        total: Number of all runs.
        settings: Number of combinations of settings.
        seeds: Number of seeds of each combination.
    """

    folder: str
    done: int
    total: int
    settings: int
    seeds: int


@dataclass(frozen=True)
class SweepRunEnded:
    """An attempt at a run of a sweep ended.

    Attributes:
        settings: Its settings: `policy=scheduled, window=10ms`.
        seed: Its seed.
        run: Name of its result.
        reason: Why it failed; empty if it is finished.
        remedy: What to do about the failure; may be empty.
        attempt: Number of the attempt, from 1.
        done: Number of finished runs.
        total: Number of all runs.
    """

    settings: str
    seed: int
    run: str
    reason: str
    remedy: str
    attempt: int
    done: int
    total: int


@dataclass(frozen=True)
class SweepEnded:
    """A sweep is finished or was stopped; the same command continues it.

    Attributes:
        folder: Its folder.
        done: Number of finished runs.
        failed: Number of failed runs that are not tried again.
        total: Number of all runs.
    """

    folder: str
    done: int
    failed: int
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
    | SweepPlanned
    | SweepRunEnded
    | SweepEnded
)
Sink = Callable[[Event], None]
