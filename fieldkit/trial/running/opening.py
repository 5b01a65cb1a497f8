"""Open the robots of a trial: open the testbed, log in everywhere, hold the locks, run.

The only place where that is done: `trial`, `resume`, `campaign` and tests go through it.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fieldkit.backends.protocols import Backend, Cast, Testbed, Transient
from fieldkit.core import runtime
from fieldkit.core.events import Note, Sink
from fieldkit.core.prompts import Operator
from fieldkit.trial import step_packages, store
from fieldkit.trial.plan import Plan
from fieldkit.trial.running import bridges, locks, motion_leave, preflight, runner
from fieldkit.trial.running.locks import Holder
from fieldkit.trial.running.resumption import demand_backend, demand_cast, resumable
from fieldkit.trial.running.runner import Outcome
from fieldkit.trial.running.stop import Stop


@contextmanager
def opened(
    backend: Backend, cast: Cast, *, session: str, what: str, seed: int, sink: Sink, operator: Operator
) -> Iterator[Testbed]:
    """Yield the testbed of a cast, every robot logged in and held by us, the bridges up that their profiles ask for.

    Args:
        backend: Where the robots come from.
        cast: Who plays which role.
        session: Names the run of fieldkit on the robots' locks.
        what: What the robots are held for, told to everyone else.
        seed: Seed of everything random in the testbed.
        sink: Told what happens.
        operator: Does what the backend cannot do by itself.

    Raises:
        ConfigurationError: A right or a program is missing on this machine, there is nothing to log in with, or
            another fieldkit runs the session.
        LinkError: A robot did not answer.
        RobotError: A robot cannot be reached, has another host key, refuses the login, or is held by somebody else.
    """
    with backend.open(cast, seed=seed, sink=sink, operator=operator) as testbed:
        preflight.meet(cast, testbed.shells, sink)
        # A lock that could not be given back is of no matter where its robot ends now.
        on_lost_lock = (lambda _: None) if isinstance(testbed, Transient) else sink
        with (
            locks.held(testbed.shells, Holder(session, runtime.me(), what), sink=on_lost_lock),
            bridges.running(cast, testbed.shells, session, sink=sink),
        ):
            yield testbed


def run(
    plans: Sequence[Plan], backend: Backend, cast: Cast, out: Path, *, sink: Sink, operator: Operator, stop: Stop
) -> list[Outcome | None]:
    """Run planned trials of one session one after the other, on robots that are opened once.

    Args:
        plans: The trials, at least one.
        backend: Where the robots come from.
        cast: Who plays which role.
        out: Folder that the trials' own folders are made in.
        sink: Told what happens.
        operator: Does what the backend cannot do by itself.
        stop: Tells the trial that runs to stop.

    Returns:
        What each came to; None for one that the operator left for later.

    Raises:
        ConfigurationError: As `motion_leave.demand_one_place`.
        FieldkitError: As `opened` and `runner.run_trial`; trials that were not begun are told.
    """
    motion_leave.demand_one_place(plans, backend, operator)
    store.prepare(out)
    first = plans[0]
    ended: list[Outcome | None] = []
    with opened(
        backend, cast, session=first.session, what=first.trial, seed=first.seed, sink=sink, operator=operator
    ) as testbed:
        try:
            for plan in plans:
                ended.append(runner.run_trial(plan, testbed, out, sink, stop))  # noqa: PERF401 (needed where one stops)
        except BaseException:
            # Whoever resumes that one alone would miss them.
            if later := plans[len(ended) + 1 :]:
                sink(Note(f"not begun: {', '.join(str(plan.distance) for plan in later)}"))
            raise
    return ended


def resume(
    folder: Path, name: str, backend: Backend, *, failed: bool, sink: Sink, operator: Operator, stop: Stop
) -> Outcome | None:
    """Go on with a trial that stopped.

    Args:
        folder: The trial's folder.
        name: Name of the backend.
        backend: Where its robots come from.
        failed: Whether failed repeats are redone too.
        sink: Told what happens.
        operator: Does what the backend cannot do by itself.
        stop: Tells the trial to stop.

    Returns:
        What it came to; None when the operator left it for later.

    Raises:
        FieldkitError: It is no trial of this fieldkit, of this backend or of these robots; or as `opened` and
            `runner.resume_trial`.
    """
    plan = resumable(folder)
    for change in step_packages.changes(plan.step_packages):
        sink(Note(change))
    demand_backend(plan, name, folder)
    demand_cast(plan, backend.cast(plan.topology))
    with opened(
        backend, plan.cast, session=plan.session, what=plan.trial, seed=plan.seed, sink=sink, operator=operator
    ) as testbed:
        return runner.resume_trial(folder, testbed, sink, stop, failed=failed)
