"""Run a planned trial: every repeat is attempted until it is valid or has failed."""

import errno
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.analysis.cells import Cell
from fieldkit.backends.protocols import Testbed
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.events import (
    ExpectationJudged,
    Note,
    PhaseStarted,
    Placed,
    RepeatEnded,
    Sink,
    TrialEnded,
    TrialStarted,
    TrialStopped,
)
from fieldkit.core.model import FINAL_STATUSES, RepeatId
from fieldkit.core.prompts import Answer
from fieldkit.core.units import TimeEstimate
from fieldkit.trial import estimates, journal, rows, store
from fieldkit.trial.estimates import FinishedRepeat
from fieldkit.trial.plan import Plan
from fieldkit.trial.running import motion_control, preflight, radio_settings
from fieldkit.trial.running.attempts import Attempts
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.stop import Stop

if TYPE_CHECKING:
    from fieldkit.analysis.judgements import Judgement


@dataclass(frozen=True)
class Outcome:
    """Result of a trial.

    Attributes:
        folder: Folder of the trial.
        cells: Summary of the trial.
        valid: Number of valid repeats.
        failed: Number of failed repeats.
        judgements: Judgements of the procedure's expectations.
    """

    folder: Path
    cells: tuple[Cell, ...]
    valid: int
    failed: int
    judgements: "tuple[Judgement, ...]" = ()


def run_trial(plan: Plan, testbed: Testbed, out: Path, sink: Sink, stop: Stop | None = None) -> Outcome | None:
    """Place the robots and run a trial; None if the operator skipped it.

    Raises the same errors as `place` and `begin`.
    """
    placement = place(plan, testbed, sink)
    if placement.answer.skip:
        return None
    return begin(plan.with_note(placement.answer.note), testbed, out, sink, stop or Stop())


@dataclass(frozen=True)
class PlacementResult:
    """Result of placing a trial's robots.

    Attributes:
        answer: The operator's answer: a note, or a request to skip the trial.
        duration_s: Time that placing the robots took, in seconds.
    """

    answer: Answer
    duration_s: float


def place(plan: Plan, testbed: Testbed, sink: Sink) -> PlacementResult:
    """Bring the robots to the places of a trial. Raises the same errors as `Testbed.place`."""
    started_s = time.monotonic()
    placement = PlacementResult(testbed.place(plan.placement), time.monotonic() - started_s)
    sink(Placed(placement.answer.skip, placement.answer.note, placement.duration_s))
    return placement


def begin(plan: Plan, testbed: Testbed, out: Path, sink: Sink, stop: Stop, *, report_resume: bool = True) -> Outcome:
    """Run the preflight checks on robots at their places, then all repeats.

    If the trial ends early, its folder contains the plan, the journal, all attempts that ended, their rows and a
    manifest, and `resumption.continue_trial` can resume it. If fieldkit was killed, the summary is missing; `rebuild`
    writes it.

    Args:
        plan: The trial.
        testbed: The robots.
        out: Folder in which the trial's folder is created.
        sink: Receives events.
        stop: Request to stop the trial.
        report_resume: True to report the command that resumes this trial if it stops.

    Raises:
        ConfigurationError: The folder cannot be created.
        LinkError: A robot did not answer at the start of a repeat.
        RobotError: A preflight check failed.
        KeyboardInterrupt: A stop was requested.
    """
    plan = plan.model_copy(update={"radios": radio_settings.read(plan, testbed.shells)})
    folder = store.create(out, plan)
    sink(Note(f"trial {folder}"))
    with journal.locked(folder), converting_write_errors(folder):
        return run_repeats(plan, testbed, folder, sink, stop, report_resume=report_resume)


def run_repeats(
    plan: Plan, testbed: Testbed, folder: Path, sink: Sink, stop: Stop, *, report_resume: bool
) -> Outcome:
    """Run the remaining repeats of a trial whose journal is locked by this process."""
    ledger = Ledger(plan, folder, stop)
    robots = Robots(plan, testbed, sink)
    for ended in ledger.ended_attempts:
        robots.unfetched.restore(ended, store.attempt_folder(folder, ended.folder))
    repeats = list(plan.repeats_in_order())
    finished_repeats = estimates.finished_repeats(plan, journal.read(folder))
    if ledger.differences:
        from fieldkit.trial.stored import verification  # noqa: PLC0415 (only a resumed trial has a manifest)

        sink(Note(f"the evidence has changed since it was stored: {verification.summarize(ledger.differences)}"))
    try:
        sink(TrialStarted(str(folder), ledger.finished_count, len(repeats)))
        robots.stop_leftover_jobs()
        sink(PhaseStarted("check"))
        variants = preflight.check_before_trial(plan, robots.shells, folder, sink)
        permission = motion_control.permission(plan, testbed, folder)
        attempts = Attempts(
            plan,
            folder,
            robots,
            ledger,
            variants=variants,
            sink=sink,
            motions=stop.motions,
            origins=permission.origins,
        )
        for interrupted in ledger.interrupted_attempts:
            attempts.recover(interrupted)
        for repeat in repeats:
            started_s = time.monotonic()
            while not ledger.is_finished(repeat):
                permission.require()
                expected_s = plan.procedure.expected_s(repeat.protocol)
                notes = plan.abort_notes(plan.scene(repeat, ""))
                with permission.reporting_holds(sink), stop.finishing(expected_s, notes):
                    remedy = attempts.make(repeat)
                    if ledger.is_finished(repeat):
                        finished_repeats.append(FinishedRepeat(plan, repeat.protocol, time.monotonic() - started_s))
                    remaining = [other for other in repeats if not ledger.is_finished(other)]
                    # This is inside the context, so that a repeat that ends after a stop request is also reported.
                    sink(
                        _repeat_event(
                            plan, ledger, len(repeats), _remaining_time(plan, remaining, finished_repeats), remedy
                        )
                    )
    except BaseException as error:
        if report_resume:
            sink(TrialStopped(str(folder), ledger.finished_count, len(repeats)))
        if isinstance(error, OSError):
            raise  # nothing can be written
        _report_unfetched(robots, sink)
        ledger.summarize()
        raise
    cells = ledger.summarize()
    robots.delete_remote()
    _report_unfetched(robots, sink)
    valid, void, failed = map(ledger.counts, FINAL_STATUSES)
    judgements = _judge(plan, cells, sink) if plan.procedure.expect else ()
    sink(TrialEnded(str(folder), valid, void, failed))
    return Outcome(folder, cells, valid, failed, judgements)


def _judge(plan: Plan, cells: Sequence[Cell], sink: Sink) -> "tuple[Judgement, ...]":
    """Judge the expectations of a procedure and report the judgements."""
    from fieldkit.analysis.judgements import judge  # noqa: PLC0415 (few procedures have expectations)

    judgements = judge(plan.procedure.expectations, cells)
    for judgement in judgements:
        sink(_judgement_event(judgement))
    return judgements


def _judgement_event(judgement: "Judgement") -> ExpectationJudged:
    from fieldkit.analysis.judgement_words import judgement_texts  # noqa: PLC0415 (few procedures have expectations)

    _, protocol, measured, interval, _ = judgement_texts(judgement)
    estimate = judgement.estimate
    return ExpectationJudged(
        expectation=judgement.expectation.text,
        protocol=protocol.lower(),
        ruling=judgement.ruling,
        why=judgement.why,
        measured=measured,
        interval=interval,
        n=estimate.n if estimate else 0,
        n_valid=judgement.cell.n_valid if judgement.cell else 0,
        n_censored=estimate.n_censored if estimate else 0,
    )


def _report_unfetched(robots: Robots, sink: Sink) -> None:
    """Report the evidence that was not fetched and is still on the robots."""
    for robot, folders in robots.unfetched.by_robot().items():
        folder_names = ", ".join(f"~/{folder}" for folder in folders)
        sink(
            Note(
                f"{robot}: evidence that was not fetched stays on the robot; delete it if you do not need it: "
                f"{folder_names}"
            )
        )


def _remaining_time(plan: Plan, remaining: Sequence[RepeatId], finished: Sequence[FinishedRepeat]) -> TimeEstimate:
    """Return the estimated duration of the remaining repeats."""
    counts = Counter(repeat.protocol for repeat in remaining)
    return estimates.total(
        estimates.estimate_repeats(plan, protocol, counts[protocol], finished) for protocol in counts
    )


def _repeat_event(plan: Plan, ledger: Ledger, total: int, remaining: TimeEstimate, remedy: str) -> RepeatEnded:
    attempt, row = ledger.last
    return RepeatEnded(
        repeat=str(attempt.repeat),
        attempt=attempt.number,
        status=attempt.status,
        reason=attempt.reason,
        summary=rows.describe(plan, row),
        done=ledger.finished_count,
        total=total,
        left_s=remaining.likely_s,
        remedy=remedy,
        left_most_s=remaining.most_s,
    )


@contextmanager
def converting_write_errors(folder: Path) -> Iterator[None]:
    """Convert errors of writing to a trial's folder, for example if the disk is full or the folder was moved."""
    try:
        yield
    except OSError as error:
        remedy = "free some space" if error.errno in {errno.ENOSPC, errno.EDQUOT} else "correct the cause"
        raise ConfigurationError(
            f"cannot be written: {error.strerror or error}; the finished repeats are saved",
            where=str(error.filename or folder),
            remedy=f"{remedy}, then: {shell_command('fieldkit', 'resume', folder)}"
            if folder.is_dir()
            else "fieldkit resume FOLDER, with the current path of the folder",
        ) from error
