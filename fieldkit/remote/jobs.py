"""Detached jobs on a robot, each with a folder, an identity, a log, an exit code and a time limit.

A lost link does not stop them.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.model import Protocol
from fieldkit.remote.command import printable
from fieldkit.remote.script import (
    CALL,
    HOME,
    REPLY_S,
    SCRIPT,
    SCRIPT_PATH,
    call,
    error_message,
    install,
    require_success,
)
from fieldkit.remote.shell import Completed, Session, Shell

__all__ = [
    "AGENT_READY_S",
    "HOME",
    "KILLED",
    "READY_S",
    "REPLY_S",
    "SCRIPT_PATH",
    "STILL_RUNNING",
    "AbortResult",
    "Job",
    "PendingJob",
    "abort",
    "begin",
    "begin_wait",
    "command",
    "exit_file",
    "install",
    "landing_marker_file",
    "limited_argv",
    "list_running",
    "ready_when_bound",
    "run",
    "serve",
    "start",
    "stationary_file",
    "stop",
    "work_folder",
]

_READY_OUTPUT: Final = b"up\n"
"""Output of `job.sh serve` when a job is ready."""

STILL_RUNNING: Final = 124
"""Exit code of a wait for a job that was still running at the timeout."""
KILLED: Final = 137
"""Exit code of a job that SIGKILL terminated."""

_HELD_LINE: Final = re.compile(rb"^held \S+ \S", re.MULTILINE)
_JOB_LINE: Final = re.compile(rb"\S+/\S+ [0-9]{1,10} ")

_LANDING_LINE: Final = re.compile(
    rb"^lands (?P<program>[!-~]+/\.jobs/[!-~]+) (?P<state>land|return|alarm|landed|silent)$", re.MULTILINE
)

_MAX_LINE_BYTES: Final = 300
"""Length to which a line about a job is shortened."""

# Forwards at most $1 bytes of each output of the program. The exit code is the program's.
_LIMITED: Final = (
    'n=$1; shift; exec 5>&1 6>&2; exit "$( { { { "$@" 3>&- 5>&- 6>&-; echo $? >&3; } 2>&1 >&4 4>&- 5>&- 6>&- '
    '| head -c "$n" >&6; } 4>&1 | head -c "$n" >&5; } 3>&1 )"'
)

READY_S: Final = 8
"""Time in which a started job must be ready; shorter than `REPLY_S`, so that the robot can report a failure."""

AGENT_READY_S: Final = 30
"""The same for a Python program, whose imports take several seconds on a busy robot or from a slow SD card."""


@dataclass(frozen=True)
class Job:
    """A command that runs detached on a robot.

    Attributes:
        folder: The folder of the attempt on the robot, from `work_folder`.
        name: A name that is unique in the folder.
        argv: The command.
        limit_s: The robot stops the job when it has been ready for this time.
        log: File in `folder` for its standard error, and for its standard output if `stdout` is None.
        stdin: File in `folder` for its standard input; None for no input.
        stdout: File in `folder` for its standard output; None for the log.
        ready: Condition for a started job to be ready: `log:TEXT`, or from `ready_when_bound`; None for no condition.
        as_root: Whether `sudo -n` runs it.
        ready_s: Time in which it must be ready, in whole seconds.
        output_limit_bytes: Maximum kept size of standard output, and of standard error; 0 for no limit.
    """

    folder: str
    name: str
    argv: tuple[str, ...]
    limit_s: float
    log: str
    stdin: str | None = None
    stdout: str | None = None
    ready: str | None = None
    as_root: bool = False
    ready_s: int = READY_S
    output_limit_bytes: int = 0


def work_folder(trial: str, attempt: str) -> str:
    """Return the folder on the robot for an attempt of a repeat."""
    return f"{HOME}/{trial}/{attempt}"


def exit_file(job: Job) -> str:
    """Return the path of the file with a job's exit code, relative to the folder of its attempt."""
    return f".jobs/{job.name}/exit"


def landing_marker_file(name: str) -> str:
    """Return the path of the file that protects a job from SIGKILL, relative to the folder of its attempt.

    A job creates it while it must not be killed, for example while it lands a drone. When all jobs are stopped, the
    job receives SIGINT like the others, but no SIGKILL while the file exists.
    """
    return f".jobs/{name}/unhurried"


def stationary_file(name: str) -> str:
    """Return the path of the file that a driving job creates when its robot is stationary.

    The path is relative to the folder of the job's attempt.
    """
    return f".jobs/{name}/stationary"


def ready_when_bound(protocol: Protocol, port: int) -> str:
    """Return the `ready` condition that a socket is bound to `port`."""
    return f"{protocol}:{port:04X}"


def command(verb: str, job: Job) -> tuple[str, ...]:
    """Return the remote command line for a job; the functions `start`, `run` and `serve` describe the verbs."""
    files = (job.stdin or "/dev/null", job.stdout or job.log, job.log)
    options = (f"{job.limit_s:.15g}", job.ready or "-", str(job.ready_s), *files)
    return (*_script(job), verb, job.folder, job.name, *options, *limited_argv(job))


def limited_argv(job: Job) -> tuple[str, ...]:
    """Return the command of a job, wrapped to limit each output to `output_limit_bytes` if there is a limit."""
    if not job.output_limit_bytes:
        return job.argv
    return ("sh", "-c", _LIMITED, "sh", str(job.output_limit_bytes), *job.argv)


def start(shell: Shell, job: Job) -> None:
    """Start a job and return when it is ready; a job that was started before is not started again.

    Raises:
        LinkError: The robot did not answer in time.
        RobotError: The job ended before it was ready, or was not ready in time; the message has the end of its log.
    """
    within_s = REPLY_S - READY_S + job.ready_s
    result = shell.run(command("start", job), deadline=Deadline.after(within_s), check=False)
    require_success(shell, result, remedy=f"inspect {job.folder} on the robot")


@dataclass(frozen=True)
class PendingJob:
    """A started job, or a wait for the end of a job that was started before.

    The control connection is silent until `end` is called or, for a job from `serve`, until the job ends.

    Attributes:
        shell: Shell of the robot.
        job: The job.
        session: The remote command of the job or of the wait.
    """

    shell: Shell
    job: Job
    session: Session

    def end(self, within_s: float) -> int:
        """Wait for the end and return the job's exit code, or `STILL_RUNNING` after the timeout of a wait.

        Raises:
            LinkError: The robot did not answer in `within_s`.
            RobotError: The robot could not start the job, has no such job, or rebooted while it ran.
        """
        result = self.session.end(deadline=Deadline.after(within_s), check=False)
        return _exit_code(self.shell, self.job, result)


def begin(shell: Shell, job: Job) -> PendingJob:
    """Start a job whose end is reported only when `PendingJob.end` requests it, so that no report disturbs the radio.

    Raises:
        LinkError: The robot did not answer.
    """
    return PendingJob(shell, job, shell.begin(command("run", job), deadline=Deadline.after(REPLY_S)))


def run(shell: Shell, job: Job) -> int:
    """Start a job and wait for its end; a job that was started before is not started again.

    The control connection is silent while the job runs.

    Returns:
        The job's exit code.

    Raises:
        LinkError: The robot did not answer within the job's limit plus `REPLY_S`, and `ready_s` if it has `ready`.
        RobotError: The job could not be started, or the robot rebooted while it ran.
    """
    session = shell.begin(command("run", job), deadline=Deadline.after(REPLY_S), until=b"")
    return PendingJob(shell, job, session).end((job.ready_s if job.ready else 0) + job.limit_s + REPLY_S)


def serve(shell: Shell, job: Job) -> PendingJob:
    """Start a job and return when it is ready; the robot reports its end without a request.

    A job that was started before is not started again. The robot waits for its end until `REPLY_S` after its limit.

    Raises:
        LinkError: The robot did not answer in time.
        RobotError: For the same reasons as `start`.
    """
    session = shell.begin(command("serve", job), deadline=Deadline.after(REPLY_S), until=_READY_OUTPUT)
    if not session.is_ready:
        result = session.end(deadline=Deadline.after(REPLY_S), check=False)
        require_success(shell, result, remedy=f"inspect {job.folder} on the robot")
    return PendingJob(shell, job, session)


def begin_wait(shell: Shell, job: Job, seconds: float) -> PendingJob:
    """Start to wait on the robot for the end of a started job, for at most `seconds`.

    Raises:
        LinkError: The robot did not answer.
    """
    argv = (*_script(job), "wait", job.folder, job.name, f"{seconds:.0f}")
    return PendingJob(shell, job, shell.begin(argv, deadline=Deadline.after(REPLY_S)))


def stop(
    shell: Shell,
    job: Job,
    *,
    signal: str = "INT",
    grace_s: float = 2.0,
    settle: str | None = None,
    end_text: str | None = None,
) -> int:
    """Stop a job, identified by its recorded process: `signal` to its group, then SIGKILL after `grace_s`.

    Args:
        shell: The robot.
        job: A started job, which may have ended.
        signal: Name without `SIG`.
        grace_s: Time until SIGKILL, in whole seconds. With `end_text` it is up to twice this time: `stop` first waits
            for the text, and then for the end.
        settle: File in `job.folder` that must stop growing before the signal, but is waited for at most 2 s; None
            to send the signal immediately.
        end_text: Text in the log that shows that the job has finished its work. `stop` then does not wait for its
            end; `fetching.fetch` waits for it, and fails if its exit code is not 0. None to wait for the end.

    Returns:
        The job's exit code, or `KILLED`; 0 if `end_text` is in its log.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The robot has no such job, or rebooted while it ran.
    """
    argv = (
        *_script(job),
        "stop",
        job.folder,
        job.name,
        signal,
        f"{grace_s:.0f}",
        settle or "-",
        *([job.log, end_text] if end_text else []),
    )
    result = shell.run(argv, deadline=Deadline.after(grace_s + REPLY_S), check=False)
    return _exit_code(shell, job, result)


def list_running(shell: Shell, deadline: Deadline) -> tuple[str, ...]:
    """Return one line per running job of fieldkit on the robot, from any trial and version.

    There is also a line for each process in a deleted folder of a job. A line consists of `FOLDER/NAME`, the process
    id and the command, separated by spaces; see `Job` for folder and name.
    """
    return _lines(call(shell, "left", deadline=deadline))


@dataclass(frozen=True)
class AbortResult:
    """Result of `abort` on a robot.

    Attributes:
        locked: Whether the robot was locked.
        jobs: A line per stopped or signalled job or process, in the format of `list_running`.
        landing: Programs that still land a drone, as `FOLDER/.jobs/NAME` (see `Job`), each with its
            `motion_states.MotionState`.
        error: The error if a part failed; None otherwise.
    """

    locked: bool = False
    jobs: tuple[str, ...] = ()
    landing: tuple[tuple[str, str], ...] = ()
    error: FieldkitError | None = None


def abort(shell: Shell, user: str, deadline: Deadline) -> AbortResult:
    """Break the robot's lock, record that `user` broke it, and stop all jobs of all trials.

    The job script is not installed for this, because a full or read-only disk may be the reason for the abort.

    Raises:
        LinkError: The robot did not answer.
    """
    argv = ("sh", "-c", 'eval "$(cat)"', SCRIPT_PATH, "abort", user)
    result = shell.run(argv, stdin=SCRIPT, deadline=deadline, check=False)
    output, error = result.stdout, None
    try:
        require_success(shell, result)
    except RobotError as script_error:
        error = script_error
    landing = tuple((match["program"].decode(), match["state"].decode()) for match in _LANDING_LINE.finditer(output))
    return AbortResult(
        locked=_HELD_LINE.search(output) is not None, jobs=_lines(output), landing=landing, error=error
    )


def _lines(output: bytes) -> tuple[str, ...]:
    # A shortened line lacks only the end of the command, because it starts with the identification of the job.
    return tuple(printable(line[:_MAX_LINE_BYTES]) for line in output.splitlines() if _JOB_LINE.match(line))


def _script(job: Job) -> Sequence[str]:
    return ("sudo", "-n", *CALL) if job.as_root else CALL


def _exit_code(shell: Shell, job: Job, result: Completed) -> int:
    if error_message(result.stderr):
        require_success(shell, result, remedy=f"inspect {job.folder} on the robot")
    return result.exit_code
