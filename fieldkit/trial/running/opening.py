"""Open the robots of trials (testbed, logins, locks, jobs of the session) and run trials on them.

`trial`, `resume`, `campaign` and the pytest plugin use this module.
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
    backend: Backend, cast: Cast, *, session: str, purpose: str, seed: int, sink: Sink, operator: Operator
) -> Iterator[Testbed]:
    """Yield the testbed of a cast. All robots are connected and locked, and the jobs of the session run on them.

    Args:
        backend: The backend.
        cast: The robot in each role.
        session: ID of the run of fieldkit in the robots' locks.
        purpose: Purpose of the locks, which is shown to other users.
        seed: Seed of all random numbers in the testbed.
        sink: Receives events.
        operator: The person who performs actions that the backend cannot perform.

    Raises:
        ConfigurationError: A permission or a program is missing on this machine, there are no credentials, or another
            process of fieldkit runs the session.
        LinkError: A robot did not answer.
        RobotError: A robot cannot be reached, has another host key, refuses the login, or is locked by another user.
    """
    with backend.open(cast, seed=seed, sink=sink, operator=operator) as testbed:
        preflight.connect_all(cast, testbed.shells, sink)
        # It does not matter if a transient robot cannot be unlocked, because it is removed now.
        unlock_sink = (lambda _: None) if isinstance(testbed, Transient) else sink
        with (
            locks.locked_exclusively(
                testbed.shells, Holder(session, runtime.user_at_host(), purpose), sink=unlock_sink
            ),
            session_jobs.running(cast, testbed.shells, session, sink=sink),
        ):
            yield testbed


def run(
    plans: Sequence[Plan], backend: Backend, cast: Cast, out: Path, *, sink: Sink, operator: Operator, stop: Stop
) -> list[Outcome | None]:
    """Run planned trials of one session, one after the other. The robots are opened once.

    Args:
        plans: The trials, at least one.
        backend: The backend.
        cast: The robot in each role.
        out: Folder in which the trials' folders are created.
        sink: Receives events.
        operator: The person who performs actions that the backend cannot perform.
        stop: Request to stop the running trial.

    Returns:
        The outcome of each trial; None for a trial that the operator skipped.

    Raises:
        ConfigurationError: For the same reasons as `motion_control.require_one_place`.
        FieldkitError: For the same reasons as `opened` and `runner.run_trial`; a note lists the trials that were not
            started.
    """
    motion_control.require_one_place(plans, backend, operator)
    store.prepare(out)
    first = plans[0]
    outcomes: list[Outcome | None] = []
    with opened(
        backend, cast, session=first.session, purpose=first.trial, seed=first.seed, sink=sink, operator=operator
    ) as testbed:
        try:
            for plan in plans:
                outcomes.append(runner.run_trial(plan, testbed, out, sink, stop))  # noqa: PERF401 (needed after an exception)
        except BaseException:
            # `resume` continues only the interrupted trial, so the operator must start the later trials.
            if later_plans := plans[len(outcomes) + 1 :]:
                sink(Note(f"not started: {', '.join(str(plan.distance) for plan in later_plans)}"))
            raise
    return outcomes
