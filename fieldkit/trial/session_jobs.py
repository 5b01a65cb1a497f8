"""Jobs that run on robots during a whole session, such as a topic bridge.

A session is one run of fieldkit with one or more trials. The jobs start before the first preflight check and run
until the session ends, so that the checks and all trials use the robots in the same state. They are normal jobs:
`fieldkit abort` stops them, and a resumed session uses jobs that are still running. Packages add such jobs by entry
points (`plugins.SESSION_JOBS`).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.core import plugins
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError, TestbedLostError
from fieldkit.core.events import Note, PhaseStarted, Sink
from fieldkit.core.threads import run_parallel
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Planned, Shells

SessionJobs = Callable[[Cast, str], Iterable[Planned]]
"""Function that returns the jobs of a session on the robots of a cast. The second argument is the ID of the session,
which must be the name of the folder of each job."""

_INSTALL_TIMEOUT_S: Final = 30.0
_GRACE_S: Final = 5
"""Time after which a job that does not stop is killed."""


def planned_jobs(cast: Cast, session: str) -> list[Planned]:
    """Return the jobs of a session.

    Args:
        cast: The robot in each role.
        session: ID of the run of fieldkit.
    """
    return [job for _, package_jobs in _by_package(cast, session) for job in package_jobs]


def _by_package(cast: Cast, session: str) -> Iterator[tuple[str, Sequence[Planned]]]:
    """Yield the name of each entry point and its jobs."""
    for point in plugins.entry_points(plugins.SESSION_JOBS):
        session_jobs: SessionJobs = plugins.load(point)
        yield point.name, list(session_jobs(cast, session))


@contextmanager
def running(cast: Cast, shells: Shells, session: str, *, sink: Sink) -> Iterator[None]:
    """Run the jobs of a session while the body runs.

    Args:
        cast: The robot in each role.
        shells: The shell of each robot.
        session: ID of the run of fieldkit.
        sink: Receives the start of the jobs, and a note on each job that did not exit successfully.

    Raises:
        LinkError: A robot did not answer.
        RobotError: A job did not start. The message contains the end of the job's log.
    """
    started_jobs: list[Planned] = []

    def start(job: Planned) -> None:
        _start(cast, shells[job.role], job)
        started_jobs.append(job)

    try:
        for name, package_jobs in _by_package(cast, session):
            if package_jobs:
                sink(PhaseStarted(f"start {name}"))
                run_parallel(start, package_jobs)
        yield
    finally:
        errors = run_parallel(lambda job: _stop(shells[job.role], job.job), started_jobs)
        for job, error in zip(started_jobs, errors, strict=True):
            if error:
                sink(Note(f"the {job.job.name} on {cast[job.role].name} {error}"))


def _start(cast: Cast, shell: Shell, planned_job: Planned) -> None:
    robot, job = cast[planned_job.role], planned_job.job
    jobs.install(shell, Deadline.after(_INSTALL_TIMEOUT_S))
    evidence.begin(shell, job.folder, planned_job.role, robot.profile.radio.interface)
    try:
        jobs.start(shell, job)
    except RobotError as error:
        raise RobotError(
            f"its {job.name} does not start: {error.what}", where=robot.name, remedy=planned_job.remedy
        ) from error


def _stop(shell: Shell, job: Job) -> str:
    """Stop a job, and return a description of the problem, or an empty string if there was none."""
    try:
        was_running = any(f"{job.folder}/" in line for line in jobs.list_running(shell, Deadline.after(jobs.REPLY_S)))
        code = jobs.stop(shell, job, grace_s=_GRACE_S)
        session = job.folder.split("/")[-2]  # the job's folder is in the folder of the session
        evidence.discard(shell, session)
    except TestbedLostError:
        return ""  # the job ended because its robot is gone
    except FieldkitError as error:
        return f"was not stopped: {error.what}"
    early = "" if was_running else "early, "
    return f"exited {early}with exit code {code}" if code or early else ""
