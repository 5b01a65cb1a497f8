"""Open the robots of a trial: open the testbed, log in on all robots, lock them, run.

`trial`, `resume`, `campaign` and the pytest plugin all use this module.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fieldkit.backends.protocols import Backend, Cast, Testbed, Transient
from fieldkit.core import runtime
from fieldkit.core.events import Note, Sink
from fieldkit.core.prompts import Operator
from fieldkit.trial import session_jobs, store
from fieldkit.trial.plan import Plan
from fieldkit.trial.running import locks, motion_control, preflight, runner
from fieldkit.trial.running.locks import Holder
from fieldkit.trial.running.runner import Outcome
from fieldkit.trial.running.stop import Stop


@contextmanager
def opened(
    backend: Backend, cast: Cast, *, session: str, what: str, seed: int, sink: Sink, operator: Operator
) -> Iterator[Testbed]:
    """Yield the testbed of a cast, with every robot logged in and locked, and the jobs of the session running.

    Args:
        backend: The backend.
        cast: The robot in each role.
        session: Identifies the run of fieldkit in the robots' locks.
        what: Purpose of the locks, shown to other users.
        seed: Seed of all random numbers in the testbed.
        sink: Receives events.
        operator: The person who does what the backend cannot do.

    Raises:
        ConfigurationError: A permission or a program is missing on this machine, there are no credentials, or another
            fieldkit runs the session.
        LinkError: A robot did not answer.
        RobotError: A robot cannot be reached, has another host key, refuses the login, or is locked by another user.
    """
    with backend.open(cast, seed=seed, sink=sink, operator=operator) as testbed:
        preflight.connect_all(cast, testbed.shells, sink)
        # Failure to unlock a transient robot does not matter, because the robot ends now.
        on_lost_lock = (lambda _: None) if isinstance(testbed, Transient) else sink
        with (
            locks.locked_exclusively(
                testbed.shells, Holder(session, runtime.user_at_host(), what), sink=on_lost_lock
            ),
            session_jobs.running(cast, testbed.shells, session, sink=sink),
        ):
            yield testbed


def run(
    plans: Sequence[Plan], backend: Backend, cast: Cast, out: Path, *, sink: Sink, operator: Operator, stop: Stop
) -> list[Outcome | None]:
    """Run planned trials of one session in sequence; their robots are opened once.

    Args:
        plans: The trials, at least one.
        backend: The backend.
        cast: The robot in each role.
        out: Folder in which the trials' folders are created.
        sink: Receives events.
        operator: The person who does what the backend cannot do.
        stop: Request to stop the running trial.

    Returns:
        The outcome of each trial; None for a trial that the operator skipped.

    Raises:
        ConfigurationError: As for `motion_control.require_one_place`.
        FieldkitError: As for `opened` and `runner.run_trial`; a note lists the trials that were not started.
    """
    motion_control.require_one_place(plans, backend, operator)
    store.prepare(out)
    first = plans[0]
    ended: list[Outcome | None] = []
    with opened(
        backend, cast, session=first.session, what=first.trial, seed=first.seed, sink=sink, operator=operator
    ) as testbed:
        try:
            for plan in plans:
                ended.append(runner.run_trial(plan, testbed, out, sink, stop))  # noqa: PERF401 (needed if one stops)
        except BaseException:
            # A person who resumes the interrupted trial alone would overlook the later ones.
            if later := plans[len(ended) + 1 :]:
                sink(Note(f"not started: {', '.join(str(plan.distance) for plan in later)}"))
            raise
    return ended
