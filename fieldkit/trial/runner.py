"""Run a planned trial, or go on with one: every repeat attempted until it is valid, or failed for good."""

import time
from dataclasses import dataclass
from pathlib import Path

from fieldkit.analysis.cells import Cell
from fieldkit.backends.protocols import Testbed
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Note, PhaseStarted, Placed, RepeatEnded, Sink, TrialEnded, TrialStopped
from fieldkit.core.model import ENDED
from fieldkit.core.prompts import Answer
from fieldkit.trial import journal, preflight, rows, store
from fieldkit.trial.attempts import Attempts
from fieldkit.trial.ledger import Ledger
from fieldkit.trial.plan import Plan
from fieldkit.trial.resumption import resumable
from fieldkit.trial.robots import Robots
from fieldkit.trial.stop import Stop


@dataclass(frozen=True)
class Outcome:
    """What a trial came to.

    Attributes:
        folder: Its folder.
        cells: Its summary.
        valid: Repeats that are valid.
        failed: Repeats that no attempt made valid.
    """

    folder: Path
    cells: tuple[Cell, ...]
    valid: int
    failed: int


def run_trial(plan: Plan, lab: Testbed, out: Path, sink: Sink, stop: Stop | None = None) -> Outcome | None:
    """Place the robots, check them, and run every repeat.

    Whatever ends the trial early, the folder holds the plan, the journal, every attempt that had ended, their rows
    and a manifest over them, and `resume_trial` goes on; only a kill leaves out the summary, which `rebuild` makes.

    Args:
        plan: The trial.
        lab: The robots.
        out: Folder that the trial's own folder is made in.
        sink: Told what happens.
        stop: Tells the trial to stop; None for never.

    Returns:
        What it came to; None when the operator left it for later.

    Raises:
        ConfigurationError: The folder cannot be made.
        LinkError: A robot did not answer when a repeat was about to begin.
        RobotError: Preflight found a problem.
        KeyboardInterrupt: `stop` was asked for.
    """
    answer = _place(plan, lab, sink)
    if answer.skip:
        return None
    plan = plan.with_note(answer.note)
    folder = store.create(out, plan)
    sink(Note(f"trial {folder}"))
    with journal.claimed(folder):
        return _run(plan, lab, folder, sink, stop or Stop())


def resume_trial(folder: Path, lab: Testbed, sink: Sink, stop: Stop | None = None) -> Outcome | None:
    """Go on with a trial that stopped: what is over stays as it is, each other repeat is run once more.

    An attempt whose steps were done is fetched and judged; one that was cut short is kept as void and counts for none
    of the attempts that the procedure allows.

    Args:
        folder: The trial's folder.
        lab: The robots of its plan.
        sink: Told what happens.
        stop: Tells the trial to stop; None for never.

    Returns:
        As `run_trial`.

    Raises:
        ConfigurationError: `folder` is no trial, other code began it, or another fieldkit runs it now.
        EvidenceError: Its journal is damaged.
        FieldkitError: As `run_trial`.
    """
    plan = resumable(folder)
    if _place(plan, lab, sink).skip:
        return None
    with journal.claimed(folder):
        return _run(plan, lab, folder, sink, stop or Stop())


def _place(plan: Plan, lab: Testbed, sink: Sink) -> Answer:
    began_s = time.monotonic()
    answer = lab.place(plan.placement)
    sink(Placed(answer.skip, answer.note, time.monotonic() - began_s))
    return answer


def _run(plan: Plan, lab: Testbed, folder: Path, sink: Sink, stop: Stop) -> Outcome:
    """Run what is left of a trial whose journal is ours."""
    robots, ledger = Robots(plan, lab), Ledger(plan, folder, stop)
    repeats = list(plan.order())
    done_before, began_s = ledger.done, time.monotonic()
    try:
        robots.end_left()
        sink(PhaseStarted("preflight"))
        variants = preflight.preflight(plan, robots.shells, folder, sink)
        attempts = Attempts(plan, folder, robots, ledger, variants=variants, sink=sink)
        for cut in ledger.cut_short:
            attempts.recover(cut)
        for repeat in repeats:
            while not ledger.is_over(repeat):
                with stop.finishing():
                    attempts.make(repeat)
                per_repeat_s = (time.monotonic() - began_s) / max(1, ledger.done - done_before)
                sink(_ended(plan, ledger, len(repeats), per_repeat_s))
    except BaseException as error:
        sink(TrialStopped(str(folder), ledger.done, len(repeats)))
        if isinstance(error, OSError):
            raise _no_room(folder, error) from error
        ledger.summarize()
        raise
    cells = ledger.summarize()
    robots.discard()
    valid, void, failed = map(ledger.counts, ENDED)
    sink(TrialEnded(str(folder), valid, void, failed))
    return Outcome(folder, cells, valid, failed)


def _ended(plan: Plan, ledger: Ledger, total: int, per_repeat_s: float) -> RepeatEnded:
    attempt, row = ledger.last
    return RepeatEnded(
        repeat=str(attempt.repeat),
        attempt=attempt.number,
        status=attempt.status,
        reason=attempt.reason,
        summary=rows.in_words(plan, row),
        done=ledger.done,
        total=total,
        left_s=per_repeat_s * (total - ledger.done),
    )


def _no_room(folder: Path, error: OSError) -> ConfigurationError:
    return ConfigurationError(
        f"cannot be written: {error.strerror or error}; what had ended is saved",
        where=str(error.filename or folder),
        remedy=f"free some space, then: fieldkit resume {folder}",
    )
