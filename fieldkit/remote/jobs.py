"""Detached jobs: a folder, an identity, a log, an exit code and a deadline on the robot; a lost link ends none."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.model import Protocol
from fieldkit.remote.command import printable
from fieldkit.remote.script import CALL, HOME, REPLY_S, SCRIPT, SCRIPT_PATH, call, complaint, demand, install
from fieldkit.remote.shell import Completed, Session, Shell

__all__ = [
    "HOME",
    "KILLED",
    "READY_S",
    "REPLY_S",
    "SCRIPT_PATH",
    "STILL_RUNNING",
    "Aborted",
    "Job",
    "Pending",
    "abort",
    "begin",
    "begin_wait",
    "bound",
    "command",
    "exit_file",
    "install",
    "left",
    "limited_argv",
    "run",
    "serve",
    "start",
    "stationary_file",
    "stop",
    "unhurried_file",
    "work_folder",
]

_UP: Final = b"up\n"
"""What `job.sh serve` says."""

STILL_RUNNING: Final = 124
KILLED: Final = 137

_HELD: Final = re.compile(rb"^held \S+ \S", re.MULTILINE)
_JOB: Final = re.compile(rb"\S+/\S+ [0-9]{1,10} ")

_LANDS: Final = re.compile(
    rb"^lands (?P<program>[!-~]+/\.jobs/[!-~]+) (?P<state>land|return|alarm|landed|silent)$", re.MULTILINE
)

_LINE_BYTES: Final = 300

# Passes at most $1 bytes of each output of the program on. The exit code is that of the program.
_LIMITED: Final = (
    'n=$1; shift; exec 5>&1 6>&2; exit "$( { { { "$@" 3>&- 5>&- 6>&-; echo $? >&3; } 2>&1 >&4 4>&- 5>&- 6>&- '
    '| head -c "$n" >&6; } 4>&1 | head -c "$n" >&5; } 3>&1 )"'
)

READY_S: Final = 8
"""How long a started job may take to be up, shorter than `REPLY_S` so that the robot itself says why it is not."""


@dataclass(frozen=True)
class Job:
    """A command that runs detached on a robot.

    Attributes:
        folder: The repeat's folder on the robot, from `work_folder`.
        name: Unique in its folder.
        argv: The command.
        limit_s: The robot itself ends the job when it has been up for this time.
        log: File in `folder` for its standard error, and its output where `stdout` is None.
        stdin: File in `folder` that it reads; None for none.
        stdout: File in `folder` that it writes; None for the log.
        ready: When a started job counts as up: `log:TEXT`, or from `bound`; None at once.
        as_root: Run by `sudo -n`.
        ready_s: How long a started job may take to be up, in whole seconds.
        output_limit_bytes: Bytes that are kept of standard output, and of standard error; 0 for no limit.
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
    """Return the folder on the robot for one attempt at a repeat."""
    return f"{HOME}/{trial}/{attempt}"


def exit_file(job: Job) -> str:
    """Return the file, in the folder of its attempt, that holds the exit code of a job that has ended."""
    return f".jobs/{job.name}/exit"


def unhurried_file(name: str) -> str:
    """Return the file, in the folder of its attempt, by which a job says that it needs its time to end.

    Who ends all jobs tells it to end as all others, and does not kill it while that is there.
    """
    return f".jobs/{name}/unhurried"


def stationary_file(name: str) -> str:
    """Return the file, in the folder of its attempt, made by a job that drives a robot when it is stationary."""
    return f".jobs/{name}/stationary"


def bound(protocol: Protocol, port: int) -> str:
    """Return the `ready` condition that a socket listens on `port`."""
    return f"{protocol}:{port:04X}"


def command(verb: str, job: Job) -> tuple[str, ...]:
    """Return the remote command line that starts (`start`), runs (`run`) or does both to a job (`serve`)."""
    files = (job.stdin or "/dev/null", job.stdout or job.log, job.log)
    options = (f"{job.limit_s:.15g}", job.ready or "-", str(job.ready_s), *files)
    return (*_script(job), verb, job.folder, job.name, *options, *limited_argv(job))


def limited_argv(job: Job) -> tuple[str, ...]:
    """Return the command of a job, inside one that keeps `output_limit_bytes` of each output if there is a limit."""
    if not job.output_limit_bytes:
        return job.argv
    return ("sh", "-c", _LIMITED, "sh", str(job.output_limit_bytes), *job.argv)


def start(shell: Shell, job: Job) -> None:
    """Start a job, or join one that was started before, and return when it is up.

    Raises:
        LinkError: The robot did not answer in time.
        RobotError: The job ended before it was up, or was not in `ready_s`; the message has the end of its log.
    """
    within_s = REPLY_S - READY_S + job.ready_s
    done = shell.run(command("start", job), deadline=Deadline.after(within_s), check=False)
    demand(shell, done, remedy=f"look into {job.folder} on the robot")


@dataclass(frozen=True)
class Pending:
    """A job, or a wait for one, that the robot has accepted; silent on the control connection until `end`.

    Attributes:
        shell: The robot.
        job: The job.
        session: Its command.
    """

    shell: Shell
    job: Job
    session: Session

    def end(self, within_s: float) -> int:
        """Wait for the end and return the job's exit code, or `STILL_RUNNING` when a wait gave up.

        Raises:
            LinkError: The robot did not answer in `within_s`.
            RobotError: The robot could not start the job, knows no such job, or rebooted while it ran.
        """
        done = self.session.end(deadline=Deadline.after(within_s), check=False)
        return _exit_code(self.shell, self.job, done)


def begin(shell: Shell, job: Job) -> Pending:
    """Start a job whose end the robot tells only when asked by `end`, so that its report meets nothing on the air.

    Raises:
        LinkError: The robot did not answer.
    """
    return Pending(shell, job, shell.begin(command("run", job), deadline=Deadline.after(REPLY_S)))


def run(shell: Shell, job: Job) -> int:
    """Start a job, or join one that was started before, and wait for its end.

    Nothing crosses the control connection in between.

    Returns:
        The job's exit code.

    Raises:
        LinkError: The robot did not answer by the end of the job's own limit, `READY_S` later if it has `ready`.
        RobotError: The job could not be started.
    """
    session = shell.begin(command("run", job), deadline=Deadline.after(REPLY_S), until=b"")
    return Pending(shell, job, session).end((READY_S if job.ready else 0) + job.limit_s + REPLY_S)


def serve(shell: Shell, job: Job) -> Pending:
    """Start a job, or join one that was started before, and return when it is up; the robot tells its end unasked.

    Its wait gives up where the job outlives its limit by `REPLY_S`.

    Raises:
        LinkError: The robot did not answer in time.
        RobotError: As `start`.
    """
    session = shell.begin(command("serve", job), deadline=Deadline.after(REPLY_S), until=_UP)
    if not session.told:
        done = session.end(deadline=Deadline.after(REPLY_S), check=False)
        demand(shell, done, remedy=f"look into {job.folder} on the robot")
    return Pending(shell, job, session)


def begin_wait(shell: Shell, job: Job, seconds: float) -> Pending:
    """Begin to wait on the robot for a started job's end, for `seconds` at most.

    Raises:
        LinkError: The robot did not answer.
    """
    argv = (*_script(job), "wait", job.folder, job.name, f"{seconds:.0f}")
    return Pending(shell, job, shell.begin(argv, deadline=Deadline.after(REPLY_S)))


def stop(
    shell: Shell,
    job: Job,
    *,
    signal: str = "INT",
    grace_s: float = 2.0,
    settle: str | None = None,
    parting: str | None = None,
) -> int:
    """End a job by its recorded identity: `signal` to its group, SIGKILL after `grace_s`.

    Args:
        shell: The robot.
        job: A started job; one that has ended is left alone.
        signal: Name without `SIG`.
        grace_s: Time to end by itself, whole seconds.
        settle: File in the job's folder that must have stopped growing first.
        parting: The job has done its work once its log has this; only `fetching.fetch` then waits for its end,
            and fails if its exit code is not 0.

    Returns:
        The job's exit code, or `KILLED`; 0 where it said `parting`.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The robot knows no such job, or rebooted while it ran.
    """
    argv = (
        *_script(job),
        "stop",
        job.folder,
        job.name,
        signal,
        f"{grace_s:.0f}",
        settle or "-",
        *([job.log, parting] if parting else []),
    )
    done = shell.run(argv, deadline=Deadline.after(grace_s + REPLY_S), check=False)
    return _exit_code(shell, job, done)


def left(shell: Shell, deadline: Deadline) -> tuple[str, ...]:
    """Return one line per job of fieldkit's that still runs on the robot, whatever trial and version started it."""
    return _lines(call(shell, "left", deadline=deadline))


@dataclass(frozen=True)
class Aborted:
    """Result of `abort` on a robot.

    Attributes:
        locked: Whether somebody held it.
        jobs: A line per job that was ended or was ordered to end, as from `left`.
        landing: Programs that still bring a drone down, `TRIAL/ATTEMPT/.jobs/NAME` below the robot's home, each with
            its `motion.MotionState`.
        error: What could not be done, if anything.
    """

    locked: bool = False
    jobs: tuple[str, ...] = ()
    landing: tuple[tuple[str, str], ...] = ()
    error: FieldkitError | None = None


def abort(shell: Shell, who: str, deadline: Deadline) -> Aborted:
    """Break the robot's lock in the name of `who` and end every job of any trial.

    The script is not installed for it, since a full disk or one that cannot be written may be why somebody aborts.

    Raises:
        LinkError: The robot did not answer.
    """
    argv = ("sh", "-c", 'eval "$(cat)"', SCRIPT_PATH, "abort", who)
    done = shell.run(argv, stdin=SCRIPT, deadline=deadline, check=False)
    said, error = done.stdout, None
    try:
        demand(shell, done)
    except RobotError as failed:
        error = failed
    landing = tuple((match["program"].decode(), match["state"].decode()) for match in _LANDS.finditer(said))
    return Aborted(locked=_HELD.search(said) is not None, jobs=_lines(said), landing=landing, error=error)


def _lines(output: bytes) -> tuple[str, ...]:
    # Each begins with what it is, and a command may be long.
    return tuple(printable(line[:_LINE_BYTES]) for line in output.splitlines() if _JOB.match(line))


def _script(job: Job) -> Sequence[str]:
    return ("sudo", "-n", *CALL) if job.as_root else CALL


def _exit_code(shell: Shell, job: Job, done: Completed) -> int:
    if complaint(done.stderr):
        demand(shell, done, remedy=f"look into {job.folder} on the robot")
    return done.exit_code
