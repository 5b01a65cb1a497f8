"""Preflight check that a shared ROS master answers the robots that use it."""

from collections.abc import Iterator
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import ROS_MASTER_PORT, Role, Verdict
from fieldkit.steps.scene import CommandResult, Need, Scene

_TIMEOUT_S: Final = 5
_OK_STATUS: Final = " 200 "
"""Part of the first line of a successful HTTP answer."""

# The simplest method of a master (wiki.ros.org/ROS/Master_API).
_CALL: Final = (
    '<?xml version="1.0"?><methodCall><methodName>getPid</methodName>'
    "<params><param><value><string>/fieldkit</string></value></param></params></methodCall>"
)
_POST: Final = f"POST /RPC2 HTTP/1.0\r\nContent-Type: text/xml\r\nContent-Length: {len(_CALL)}\r\n\r\n{_CALL}"
# bash can open TCP connections, and every robot with ROS has it, because the setup files of ROS need it.
_REQUEST: Final = 'exec 3<>"/dev/tcp/$1/$2" && printf %s "$3" >&3 && read -r line <&3 && echo "$line"'


def needs(scene: Scene, role: Role, *, program: str) -> Iterator[Need]:
    """Yield the check that the shared master answers a robot; nothing if the robot shares no master.

    Args:
        scene: Any scene of the trial.
        role: Role of the robot.
        program: Program that needs the master.
    """
    robot = scene.robot(role)
    if robot.ros_master:
        master = next(other for other in scene.cast.values() if other.address == robot.ros_master)
        arguments = (robot.ros_master, str(ROS_MASTER_PORT), _POST)
        argv = ("timeout", str(_TIMEOUT_S), "bash", "-c", _REQUEST, "bash", *arguments)
        yield Need(role, "ROS master", argv, lambda answer: judge(master, answer), missing_program=program)


def judge(master: Robot, answer: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the first line of a master's HTTP answer."""
    where = f"{master.name}, {master.address}:{ROS_MASTER_PORT}"
    if answer.ok and _OK_STATUS in answer.text:
        return Verdict.OK, where, ""
    output = answer.text or "no output"
    start = f"on {master.name}: ROS_HOSTNAME={master.address} roscore"
    remedy = f"{start}   # or bring the robots closer, or correct ros_master in the site file"
    return Verdict.FAIL, f"no master answers at {where}: {output}", remedy
