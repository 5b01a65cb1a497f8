"""Stop what moves robots: programs of the agent that drive or fly them, whatever fieldkit has started them."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError
from fieldkit.core.threads import together
from fieldkit.remote.script import SCRIPT, SCRIPT_PATH, call, demand, word
from fieldkit.remote.shell import Shell

_LINE: Final = re.compile(r"(?P<program>\S+/\.jobs/\S+) (?P<state>[a-z]+)")


class MotionState(StrEnum):
    """What a robot does that was told to stop, the worst last; `job.sh` has the same words for each program.

    Attributes:
        NOTHING: No program of fieldkit moves it; nothing is sent to it.
        STATIONARY: Its odometry shows no motion.
        LANDED: Its motors have stopped.
        ENDED: The program has ended without a word about the robot: it had not begun to move it.
        LAND: A drone is coming down where it is.
        RETURN: A drone is coming back, and then down.
        SILENT: The program was signalled and has not confirmed anything. One that drives was killed.
        ALARM: The program cannot bring its drone down now: its autopilot is not heard, or another party flies it.
    """

    NOTHING = "nothing"
    STATIONARY = "stationary"
    LANDED = "landed"
    ENDED = "ended"
    LAND = "land"
    RETURN = "return"
    SILENT = "silent"
    ALARM = "alarm"


_ORDER: Final = tuple(MotionState)
COMING_DOWN: Final = frozenset({MotionState.LAND, MotionState.RETURN})

IN_WORDS: Final[Mapping[MotionState, str]] = {
    MotionState.NOTHING: "nothing of fieldkit moves it; nothing was sent to it",
    MotionState.STATIONARY: "stopped (standing)",
    MotionState.LANDED: "stopped (on the ground)",
    MotionState.ENDED: "stopped (its program had not begun to move it, or has ended)",
    MotionState.LAND: "coming down (land)",
    MotionState.RETURN: "coming down (return)",
    MotionState.SILENT: "NOT CONFIRMED: stop it by hand; its program was ended and has not confirmed that it stands",
    MotionState.ALARM: "ALARM: IT MAY STILL BE IN THE AIR, AND ITS AUTOPILOT IS NOT HEARD OR DOES NOT OBEY. "
    "TAKE IT OVER BY REMOTE CONTROL, OR COMMAND LAND OR RTL AT THE GROUND STATION",
}


@dataclass(frozen=True)
class Halted:
    """Result of `halt` on a robot.

    Attributes:
        programs: State of each program that was stopped, by `TRIAL/ATTEMPT/.jobs/NAME` below the robot's home.
        error: What could not be done, if anything: the robot was not reached, or its lock not written.
    """

    programs: tuple[tuple[str, MotionState], ...] = ()
    error: FieldkitError | None = None

    @property
    def state(self) -> MotionState:
        """What the robot does: the worst state of its programs."""
        states = (state for _, state in self.programs)
        return max(states, key=_ORDER.index, default=MotionState.NOTHING)


def halt(shell: Shell, who: str, deadline: Deadline) -> Halted:
    """Stop every program that moves a robot, of any trial, and the trial that holds the robot.

    The script is not installed for it, as for `jobs.abort`: a full disk does not keep a robot from stopping.

    Args:
        shell: The robot.
        who: Named to those whose trial ends.
        deadline: When to give up.

    Raises:
        LinkError: The robot did not answer.
    """
    argv = ("sh", "-c", 'eval "$(cat)"', SCRIPT_PATH, "halt_motion", word(who))
    done = shell.run(argv, stdin=SCRIPT, deadline=deadline, check=False)
    error = None
    try:
        demand(shell, done)
    except FieldkitError as failed:
        error = failed
    return Halted(_states(done.stdout), error)


def halt_attempt(shell: Shell, folder: str, who: str, deadline: Deadline) -> Halted:
    """Stop every program that moves a robot for an attempt, whose folder this is; the robot has the job script.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The script failed.
    """
    return Halted(_states(call(shell, "halt_motion", word(who), folder, deadline=deadline)))


def look(shell: Shell, programs: Iterable[str], deadline: Deadline) -> Halted:
    """Return the state of programs that `halt_attempt` returned; errors as there."""
    return Halted(_states(call(shell, "motion_states", *programs, deadline=deadline)))


def life_signs(shell: Shell, file: str, deadline: Deadline) -> bytes:
    """Return the file that the pilot and the guard of a drone share, then /proc/uptime; errors as `halt_attempt`."""
    return call(shell, "life_signs", file, deadline=deadline)


def halt_all(
    robots: Mapping[str, Shell | FieldkitError],
    who: str,
    within_s: float,
    report: Callable[[str, Halted], None] = lambda _name, _halted: None,
) -> Mapping[str, Halted]:
    """Stop every program that moves a robot, on all robots in parallel; return the result of each.

    Args:
        robots: From `Backend.standing`.
        who: See `halt`.
        within_s: How long each robot may take.
        report: Receives each result as soon as there is one, in any thread.
    """

    def stop(name: str) -> Halted:
        robot = robots[name]
        try:
            halted = (
                Halted(error=robot)
                if isinstance(robot, FieldkitError)
                else halt(robot, who, Deadline.after(within_s))
            )
        except FieldkitError as error:
            halted = Halted(error=error)
        report(name, halted)
        return halted

    return dict(zip(robots, together(stop, list(robots)), strict=True))


def _states(output: bytes) -> tuple[tuple[str, MotionState], ...]:
    found = map(_LINE.fullmatch, output.decode("utf-8", "replace").splitlines())
    known = set(MotionState)
    return tuple((line["program"], MotionState(line["state"])) for line in found if line and line["state"] in known)
