"""Run a planned trial, or go on with one: every repeat attempted until it is valid, or failed for good."""

import errno
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.judgements import Judgement, judge
from fieldkit.backends.protocols import Testbed
from fieldkit.core.errors import ConfigurationError, typed
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
from fieldkit.core.model import ENDED, RepeatId
from fieldkit.core.prompts import Answer
from fieldkit.core.units import TimeEstimate
from fieldkit.trial import estimates, journal, manifest, rows, store
from fieldkit.trial.estimates import Taken
from fieldkit.trial.plan import Plan
from fieldkit.trial.running import preflight
from fieldkit.trial.running.attempts import Attempts
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.motion_leave import MotionLeave
from fieldkit.trial.running.resumption import resumable
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.stop import Stop


@dataclass(frozen=True)
class Outcome:
    """Result of a trial.

    Attributes:
        folder: Its folder.
        cells: Its summary.
        valid: Repeats that are valid.
        failed: Repeats that no attempt made valid.
        judgements: What the summary says of the procedure's expectations.
    """

    folder: Path
    cells: tuple[Cell, ...]
    valid: int
    failed: int
    judgements: tuple[Judgement, ...] = ()


def run_trial(plan: Plan, testbed: Testbed, out: Path, sink: Sink, stop: Stop | None = None) -> Outcome | None:
    """Place the robots and run a trial; None when the operator left it for later. Errors as `place` and `begin`."""
    placing = place(plan, testbed, sink)
    if placing.answer.skip:
        return None
    return begin(plan.with_note(placing.answer.note), testbed, out, sink, stop or Stop())


def resume_trial(
    folder: Path, testbed: Testbed, sink: Sink, stop: Stop | None = None, *, failed: bool = False
) -> Outcome | None:
    """Place the robots and go on with a trial; None when the operator left it for later. Errors as `go_on`."""
    placing = place(resumable(folder), testbed, sink)
    return None if placing.answer.skip else go_on(folder, testbed, sink, stop or Stop(), failed=failed)


@dataclass(frozen=True)
class Placing:
    """Placing of a trial's robots.

    Attributes:
        answer: What the operator said to it: a note, or to leave the trial for later.
        took_s: How long it took.
    """

    answer: Answer
    took_s: float


def place(plan: Plan, testbed: Testbed, sink: Sink) -> Placing:
    """Bring the robots to the places of a trial; errors as `Testbed.place`."""
    began_s = time.monotonic()
    placing = Placing(testbed.place(plan.placement), time.monotonic() - began_s)
    sink(Placed(placing.answer.skip, placing.answer.note, placing.took_s))
    return placing


def begin(plan: Plan, testbed: Testbed, out: Path, sink: Sink, stop: Stop, *, told: bool = True) -> Outcome:
    """Check robots that stand at their places, and run every repeat.

    Whatever ends the trial early, the folder holds the plan, the journal, every attempt that had ended, their rows
    and a manifest over them, and `go_on` goes on; only a kill leaves out the summary, which `rebuild` makes.

    Args:
        plan: The trial.
        testbed: The robots.
        out: Folder that the trial's own folder is made in.
        sink: Told what happens.
        stop: Tells the trial to stop.
        told: Whether to tell how to go on with this trial alone when it stops.

    Raises:
        ConfigurationError: The folder cannot be made.
        LinkError: A robot did not answer when a repeat was about to begin.
        RobotError: Preflight found a problem.
        KeyboardInterrupt: `stop` was asked for.
    """
    folder = store.create(out, plan)
    sink(Note(f"trial {folder}"))
    with journal.claimed(folder), _writing(folder):
        return _run(plan, testbed, folder, sink, stop, told=told)


def go_on(
    folder: Path, testbed: Testbed, sink: Sink, stop: Stop, *, told: bool = True, failed: bool = False
) -> Outcome:
    """Go on with a trial that stopped: what is over stays as it is, each other repeat is run once more.

    An attempt whose steps were done is fetched and judged; one that was cut short is kept as void and counts for none
    of the attempts that the procedure allows.

    Args:
        folder: The trial's folder.
        testbed: The robots of its plan, at their places.
        sink: Told what happens.
        stop: Tells the trial to stop.
        told: As `begin`.
        failed: Whether failed repeats are redone too, with as many attempts as the procedure allows.

    Raises:
        ConfigurationError: `folder` is no trial, other code began it, or another fieldkit runs it now.
        EvidenceError: Its journal is damaged.
        FieldkitError: As `begin`.
    """
    plan = resumable(folder)
    with journal.claimed(folder), _writing(folder):
        if failed and not journal.reopen_failed(folder, plan) and told:
            sink(Note("no repeat of this trial failed"))
        return _run(plan, testbed, folder, sink, stop, told=told)


def _run(plan: Plan, testbed: Testbed, folder: Path, sink: Sink, stop: Stop, *, told: bool) -> Outcome:
    """Run what is left of a trial whose journal is ours."""
    ledger = Ledger(plan, folder, stop)
    robots = Robots(plan, testbed, sink)
    for ended in ledger.ended:
        robots.remember(ended, store.attempt_folder(folder, ended.folder))
    repeats = list(plan.order())
    past = estimates.taken(plan, journal.read(folder))
    if ledger.differences:
        sink(Note(f"not as it was when it was kept, and left so: {manifest.few(ledger.differences)}"))
    try:
        sink(TrialStarted(str(folder), ledger.done, len(repeats)))
        robots.end_left()
        sink(PhaseStarted("preflight"))
        variants = preflight.preflight(plan, robots.shells, folder, sink)
        leave = MotionLeave(plan, testbed, folder)
        attempts = Attempts(
            plan,
            folder,
            robots,
            ledger,
            variants=variants,
            sink=sink,
            motions=stop.motions,
            origins=leave.origins,
        )
        for cut in ledger.cut_short:
            attempts.recover(cut)
        for repeat in repeats:
            began_s = time.monotonic()
            while not ledger.is_over(repeat):
                leave.demand()
                lasts_s = plan.procedure.expected_s(repeat.protocol)
                notes = plan.abort_notes(plan.scene(repeat, ""))
                with leave.noting(sink), stop.finishing(lasts_s, notes):
                    remedy = attempts.make(repeat)
                    if ledger.is_over(repeat):
                        past.append(Taken(plan, repeat.protocol, time.monotonic() - began_s))
                    left = [one for one in repeats if not ledger.is_over(one)]
                    # Before a request to stop is taken up: what was let finish is told too.
                    sink(_ended(plan, ledger, len(repeats), _left(plan, left, past), remedy))
    except BaseException as error:
        if told:
            sink(TrialStopped(str(folder), ledger.done, len(repeats)))
        if isinstance(error, OSError):
            raise  # nothing more can be written
        _tell_left(robots, sink)
        ledger.summarize()
        raise
    cells = ledger.summarize()
    robots.discard()
    _tell_left(robots, sink)
    valid, void, failed = map(ledger.counts, ENDED)
    judgements = judge(plan.procedure.expectations, cells)
    _show_judgements(judgements, sink)
    sink(TrialEnded(str(folder), valid, void, failed))
    return Outcome(folder, cells, valid, failed, judgements)


def _show_judgements(judgements: Iterable[Judgement], sink: Sink) -> None:
    for judgement in judgements:
        sink(_judged(judgement))


def _judged(judgement: Judgement) -> ExpectationJudged:
    _, protocol, measured, interval, _ = wording.judged(judgement)
    found = judgement.found
    return ExpectationJudged(
        expectation=judgement.expectation.text,
        protocol=protocol.lower(),
        ruling=judgement.ruling,
        why=judgement.why,
        measured=measured,
        interval=interval,
        n=found.n if found else 0,
        n_valid=judgement.cell.n_valid if judgement.cell else 0,
        n_censored=found.n_censored if found else 0,
    )


def _tell_left(robots: Robots, sink: Sink) -> None:
    """Tell what was not fetched, which is on the robots still."""
    for robot, folders in robots.left().items():
        where = ", ".join(f"~/{folder}" for folder in folders)
        sink(Note(f"{robot}: evidence that was not fetched stays on it; delete it when nobody needs it: {where}"))


def _left(plan: Plan, left: Sequence[RepeatId], past: Sequence[Taken]) -> TimeEstimate:
    """Return how long the repeats take that are left."""
    counts = Counter(repeat.protocol for repeat in left)
    return estimates.total(estimates.of_repeats(plan, protocol, counts[protocol], past) for protocol in counts)


def _ended(plan: Plan, ledger: Ledger, total: int, left: TimeEstimate, remedy: str) -> RepeatEnded:
    attempt, row = ledger.last
    return RepeatEnded(
        repeat=str(attempt.repeat),
        attempt=attempt.number,
        status=attempt.status,
        reason=attempt.reason,
        summary=rows.in_words(plan, row),
        done=ledger.done,
        total=total,
        left_s=left.likely_s,
        remedy=remedy,
        left_most_s=left.most_s,
    )


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Say what to do where a trial's folder cannot be written any more: the disk is full, or it was moved away."""
    try:
        yield
    except OSError as error:
        first = "free some space" if error.errno in {errno.ENOSPC, errno.EDQUOT} else "mend that"
        raise ConfigurationError(
            f"cannot be written: {error.strerror or error}; what had ended is saved",
            where=str(error.filename or folder),
            remedy=f"{first}, then: {typed('fieldkit', 'resume', folder)}"
            if folder.is_dir()
            else "fieldkit resume FOLDER, where that is now",
        ) from error
