"""Bridges of a session: `fieldkit bridge` on each robot whose profile asks for it (`ros: bridge:`).

A bridge is up before the first check and ends with the session, so that preflight, people and every trial of it find
the robot as it will be. It is a job like any other: `fieldkit abort` ends it, and who resumes joins it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from fieldkit.backends.protocols import Cast, Robot
from fieldkit.config.profiles import RobotBridge, Ros
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError, TestbedLostError
from fieldkit.core.events import Note, PhaseStarted, Sink
from fieldkit.core.model import BRIDGE_IS_UP, Role
from fieldkit.core.threads import together
from fieldkit.remote import evidence, jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Shells

LIMIT_S: Final = 12 * 3600.0
"""How long a bridge goes on by itself, if nobody ends it."""

_MASTER_S: Final = 5
_READY_S: Final = 40
"""A small computer takes seconds to load Python, rospy and a middleware."""
_INSTALLS_S: Final = 30.0
_GRACE_S: Final = 5
_LOG: Final = "bridge.log"


def folder_of(session: str) -> str:
    """Return the folder in fieldkit's own on a robot in which a session's bridge runs."""
    return f"bridge-{session}"


def jobs_of(cast: Cast, session: str) -> dict[Role, Job]:
    """Return the bridge of each robot whose profile asks for one.

    Of robots that share a ROS master, the first carries what all of them publish to it: a second would say it twice.
    """
    found: dict[Role, Job] = {}
    masters: set[str] = set()
    for role, robot in cast.items():
        ros = robot.profile.ros
        if ros is not None and ros.bridge is not None and robot.ros_master not in masters:
            masters.update({robot.ros_master} - {""})
            found[role] = _job(robot, ros, ros.bridge, session)
    return found


def _job(robot: Robot, ros: Ros, bridge: RobotBridge, session: str) -> Job:
    command = bridge.command(robot.address, robot.ros_master, _MASTER_S)
    return Job(
        folder=jobs.work_folder(folder_of(session), "1"),
        name="bridge",
        argv=with_environment(command, setup=ros.command.setup, environment=ros.environment),
        limit_s=LIMIT_S,
        log=_LOG,
        ready=f"log:{BRIDGE_IS_UP}",
        ready_s=_READY_S,
    )


@contextmanager
def running(cast: Cast, shells: Shells, session: str, *, sink: Sink) -> Iterator[None]:
    """Let the bridges run while the body does.

    Args:
        cast: Who plays which role.
        shells: The robots.
        session: Names the run of fieldkit.
        sink: Told when they start, and of one that did not end well.

    Raises:
        LinkError: A robot did not answer.
        RobotError: A bridge did not come up; the message has the end of its log.
    """
    wanted = jobs_of(cast, session)
    if not wanted:
        yield
        return
    sink(PhaseStarted("start bridges"))
    up: list[Role] = []

    def start(role: Role) -> None:
        _start(cast[role], shells[role], role, wanted[role])
        up.append(role)

    try:
        together(start, wanted)
        yield
    finally:
        for role, error in zip(up, together(lambda role: _end(shells[role], wanted[role]), up), strict=True):
            if error:
                sink(Note(f"the bridge on {cast[role].name} {error}"))


def _start(robot: Robot, shell: Shell, role: Role, job: Job) -> None:
    jobs.install(shell, Deadline.after(_INSTALLS_S))
    evidence.begin(shell, job.folder, role, robot.profile.radio.interface)
    try:
        jobs.start(shell, job)
    except RobotError as error:
        raise RobotError(
            f"its bridge does not start: {error.what}",
            where=robot.name,
            remedy="see what it needs there: fieldkit docs bridge; or leave ros.bridge out of a copy of the profile",
        ) from error


def _end(shell: Shell, job: Job) -> str:
    """End a bridge; return what went wrong, empty if nothing did."""
    try:
        runs = any(f"{job.folder}/" in line for line in jobs.left(shell, Deadline.after(jobs.REPLY_S)))
        code = jobs.stop(shell, job, grace_s=_GRACE_S)
        evidence.discard(shell, job.folder.split("/")[-2])
    except TestbedLostError:
        return ""  # it ended with its robot
    except FieldkitError as error:
        return f"was not ended: {error.what}"
    early = "" if runs else "before its time, "
    return f"ended {early}with exit code {code}" if code or early else ""
