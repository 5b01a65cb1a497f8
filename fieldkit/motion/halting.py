"""Stop fieldkit's programs that drive or fly robots, including programs of other instances of fieldkit."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError
from fieldkit.core.threads import run_parallel
from fieldkit.remote.motion_states import BY_SEVERITY, MotionState
from fieldkit.remote.script import SCRIPT, SCRIPT_PATH, call, require_success, word
from fieldkit.remote.shell import Shell

_LINE: Final = re.compile(r"(?P<program>\S+/\.jobs/\S+) (?P<state>[a-z]+)")


@dataclass(frozen=True)
class HaltResult:
    """Result of a stop, or of a query of the states, on one robot.

    Attributes:
        programs: State of each program that was stopped, by `FOLDER/.jobs/NAME` (`jobs.Job`).
        error: The error if the robot was not reached or its lock could not be written; None otherwise.
    """

    programs: tuple[tuple[str, MotionState], ...] = ()
    error: FieldkitError | None = None

    @property
    def state(self) -> MotionState:
        """State of the robot: the worst state of its programs; `NOTHING` without programs."""
        states = (state for _, state in self.programs)
        return max(states, key=BY_SEVERITY.index, default=MotionState.NOTHING)


def halt(shell: Shell, operator: str, deadline: Deadline) -> HaltResult:
    """Stop all programs that move a robot, from any trial, and the trial that has locked the robot.

    The job script is sent on standard input and not installed, because a full disk must not prevent a stop (as in
    `jobs.abort`).

    Args:
        shell: The robot.
        operator: Name of the operator, which is reported to the stopped trial.
        deadline: Time limit.

    Raises:
        LinkError: The robot did not answer.
    """
    argv = ("sh", "-c", 'eval "$(cat)"', SCRIPT_PATH, "halt_motion", word(operator))
    completed = shell.run(argv, stdin=SCRIPT, deadline=deadline, check=False)
    error = None
    try:
        require_success(shell, completed)
    except FieldkitError as script_error:
        error = script_error
    return HaltResult(_states(completed.stdout), error)


def halt_attempt(shell: Shell, folder: str, operator: str, deadline: Deadline) -> HaltResult:
    """Stop all programs that move a robot for the attempt with this folder; the job script must be installed.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The script failed.
    """
    return HaltResult(_states(call(shell, "halt_motion", word(operator), folder, deadline=deadline)))


def poll_states(shell: Shell, programs: Iterable[str], deadline: Deadline) -> HaltResult:
    """Return the current state of programs that `halt_attempt` has stopped.

    Raises the same errors as `halt_attempt`.
    """
    return HaltResult(_states(call(shell, "motion_states", *programs, deadline=deadline)))


def read_liveness(shell: Shell, file: str, deadline: Deadline) -> bytes:
    """Return the liveness file of a drone's pilot and guard, followed by /proc/uptime.

    The pilot is the program that flies the drone, the guard is the program that lands it if the pilot fails. The file
    contains their counters, which show that they run.

    Raises the same errors as `halt_attempt`.
    """
    return call(shell, "life_signs", file, deadline=deadline)


def halt_all(
    robots: Mapping[str, Shell | FieldkitError],
    operator: str,
    within_s: float,
    report: Callable[[str, HaltResult], None] = lambda _name, _result: None,
) -> Mapping[str, HaltResult]:
    """Stop all programs that move robots, on all robots in parallel; return the result of each.

    Args:
        robots: The robots, from `Backend.persistent_shells`.
        operator: Name of the operator, see `halt`.
        within_s: Timeout for each robot.
        report: Called with each result as soon as it is known, in any thread.
    """

    def stop(name: str) -> HaltResult:
        robot = robots[name]
        try:
            result = (
                HaltResult(error=robot)
                if isinstance(robot, FieldkitError)
                else halt(robot, operator, Deadline.after(within_s))
            )
        except FieldkitError as error:
            result = HaltResult(error=error)
        report(name, result)
        return result

    return dict(zip(robots, run_parallel(stop, list(robots)), strict=True))


def _states(output: bytes) -> tuple[tuple[str, MotionState], ...]:
    matches = map(_LINE.fullmatch, output.decode("utf-8", "replace").splitlines())
    valid_states = set(MotionState)
    return tuple(
        (line["program"], MotionState(line["state"])) for line in matches if line and line["state"] in valid_states
    )
