"""Bridges of a session: `fieldkit bridge` on each robot whose profile requests it (`ros: bridge:`).

A bridge runs from before the first check until the end of the session, so preflight, people and every trial of the
session use the robot in the same state. It is a normal job: `fieldkit abort` ends it, and a resumed session uses the
running bridge.
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
from fieldkit.core.threads import run_parallel
from fieldkit.remote import evidence, jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Shells

LIMIT_S: Final = 12 * 3600.0
"""Maximum duration of a bridge that is not stopped."""

_MASTER_S: Final = 5
_READY_S: Final = 40
"""A small computer needs seconds to load Python, rospy and a middleware."""
_INSTALL_TIMEOUT_S: Final = 30.0
_GRACE_S: Final = 5
_LOG: Final = "bridge.log"


def folder_of(session: str) -> str:
    """Return the name of the folder of a session's bridge, below fieldkit's folder on a robot."""
    return f"bridge-{session}"


def jobs_of(cast: Cast, session: str) -> dict[Role, Job]:
    """Return the bridge job of each robot whose profile requests one.

    If robots share a ROS master, only the first gets a bridge, which forwards the messages of all of them; a second
    bridge would publish each message twice.
    """
    bridges: dict[Role, Job] = {}
    masters: set[str] = set()
    for role, robot in cast.items():
        ros = robot.profile.ros
        if ros is not None and ros.bridge is not None and robot.ros_master not in masters:
            masters.update({robot.ros_master} - {""})
            bridges[role] = _job(robot, ros, ros.bridge, session)
    return bridges


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
    """Run the bridges while the body runs.

    Args:
        cast: The robot in each role.
        shells: The robots.
        session: Identifies the run of fieldkit.
        sink: Receives the start of the bridges, and a note if one did not exit successfully.

    Raises:
        LinkError: A robot did not answer.
        RobotError: A bridge did not start; the message has the end of its log.
    """
    bridge_jobs = jobs_of(cast, session)
    if not bridge_jobs:
        yield
        return
    sink(PhaseStarted("start bridges"))
    running_roles: list[Role] = []

    def start(role: Role) -> None:
        _start(cast[role], shells[role], role, bridge_jobs[role])
        running_roles.append(role)

    try:
        run_parallel(start, bridge_jobs)
        yield
    finally:
        for role, error in zip(
            running_roles,
            run_parallel(lambda role: _end(shells[role], bridge_jobs[role]), running_roles),
            strict=True,
        ):
            if error:
                sink(Note(f"the bridge on {cast[role].name} {error}"))


def _start(robot: Robot, shell: Shell, role: Role, job: Job) -> None:
    jobs.install(shell, Deadline.after(_INSTALL_TIMEOUT_S))
    evidence.begin(shell, job.folder, role, robot.profile.radio.interface)
    try:
        jobs.start(shell, job)
    except RobotError as error:
        raise RobotError(
            f"its bridge does not start: {error.what}",
            where=robot.name,
            remedy="see its requirements: fieldkit docs bridge; or leave ros.bridge out of a copy of the profile",
        ) from error


def _end(shell: Shell, job: Job) -> str:
    """Stop a bridge; return a description of the problem, or an empty text."""
    try:
        was_running = any(f"{job.folder}/" in line for line in jobs.list_running(shell, Deadline.after(jobs.REPLY_S)))
        code = jobs.stop(shell, job, grace_s=_GRACE_S)
        evidence.discard(shell, job.folder.split("/")[-2])
    except TestbedLostError:
        return ""  # it exited with its robot
    except FieldkitError as error:
        return f"was not stopped: {error.what}"
    early = "" if was_running else "early, "
    return f"exited {early}with exit code {code}" if code or early else ""
