"""Bridges of a session: `fieldkit bridge` on each robot whose profile requests it (`ros: bridge:`)."""

from collections.abc import Iterator
from typing import Final

from fieldkit.backends.protocols import Cast, Robot
from fieldkit.config import locations
from fieldkit.config.profiles import RobotBridge, Ros
from fieldkit.core.model import BRIDGE_IS_UP, Role
from fieldkit.remote import jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.steps.scene import BY_FIELDKIT, Planned

LIMIT_S: Final = 12 * 3600.0
"""Maximum duration of a bridge that is not stopped."""

_MASTER_TIMEOUT_S: Final = 5
"""Time for which the bridge waits for the ROS master, in seconds."""
_READY_TIMEOUT_S: Final = 40
"""Timeout for the start: a small computer needs many seconds to load Python, rospy and a middleware."""
_LOG: Final = "bridge.log"
_REMEDY: Final = (
    "see its requirements: fieldkit docs bridge; on the robot: python3 -m pip install 'fieldkit[ros2]'; or correct "
    "ros.bridge, or leave it out, in a copy of the profile"
)


def folder_of(session: str) -> str:
    """Return the name of the folder of a session's bridge, below fieldkit's folder on a robot."""
    return f"bridge-{session}"


def planned(cast: Cast, session: str) -> Iterator[Planned]:
    """Yield the bridge of each robot whose profile requests one: entry point `bridges` of `fieldkit.session_jobs`.

    If several robots share a ROS master, only the first one has a bridge, which forwards the messages of all of them.
    With a second bridge, each message would be published twice.
    """
    masters: set[str] = set()
    for role, robot in cast.items():
        ros = robot.profile.ros
        if ros is not None and ros.bridge is not None and robot.ros_master not in masters:
            masters.update({robot.ros_master} - {""})
            yield _bridge(role, robot, ros, ros.bridge, session)


def _bridge(role: Role, robot: Robot, ros: Ros, bridge: RobotBridge, session: str) -> Planned:
    command = bridge.command(robot.address, robot.ros_master, _MASTER_TIMEOUT_S)
    job = Job(
        folder=jobs.work_folder(folder_of(session), "1"),  # a subfolder per attempt; a bridge is started only once
        name="bridge",
        argv=with_environment(command, setup=ros.command.setup, environment=ros.environment),
        limit_s=LIMIT_S,
        log=_LOG,
        ready=f"log:{BRIDGE_IS_UP}",
        ready_s=_READY_TIMEOUT_S,
    )
    return Planned(
        role,
        job,
        program=bridge.program,
        setup=ros.command.setup,
        permitted_causes=BY_FIELDKIT,
        remedy=f"{_REMEDY}: {locations.copy_profile_command(robot.profile.name)}",
    )
