"""Preflight of the ROS master that robots share: whether it answers, from where a recorder asks it."""

from collections.abc import Iterator
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import ROS_MASTER_PORT, Role, Verdict
from fieldkit.steps.scene import Need, Said, Scene

_ANSWERS_S: Final = 5
_OK: Final = " 200 "

# The least that a master answers (wiki.ros.org/ROS/Master_API).
_CALL: Final = (
    '<?xml version="1.0"?><methodCall><methodName>getPid</methodName>'
    "<params><param><value><string>/fieldkit</string></value></param></params></methodCall>"
)
_POST: Final = f"POST /RPC2 HTTP/1.0\r\nContent-Type: text/xml\r\nContent-Length: {len(_CALL)}\r\n\r\n{_CALL}"
# A robot with ROS has bash, which its setup files are written for, and no other program is sure to be there.
_ASK: Final = 'exec 3<>"/dev/tcp/$1/$2" && printf %s "$3" >&3 && read -r line <&3 && echo "$line"'


def needs(scene: Scene, role: Role, *, explains: str) -> Iterator[Need]:
    """Yield that the master which a robot shares with others answers it; nothing of one with a master of its own.

    Args:
        scene: Any scene of the trial.
        role: Whose robot.
        explains: Program that cannot work without it.
    """
    robot = scene.robot(role)
    if robot.ros_master:
        master = next(other for other in scene.cast.values() if other.address == robot.ros_master)
        asked = (robot.ros_master, str(ROS_MASTER_PORT), _POST)
        argv = ("timeout", str(_ANSWERS_S), "bash", "-c", _ASK, "bash", *asked)
        yield Need(role, "ROS master", argv, lambda answer: judged(master, answer), explains=explains)


def judged(master: Robot, answer: Said) -> tuple[Verdict, str, str]:
    """Return what a master's answer is worth, the first line of HTTP."""
    where = f"{master.name}, {master.address}:{ROS_MASTER_PORT}"
    if answer.ok and _OK in answer.text:
        return Verdict.OK, where, ""
    said = answer.text or "silence"
    start = f"on {master.name}: ROS_HOSTNAME={master.address} roscore"
    remedy = f"{start}   # or bring the robots closer, or correct ros_master in the site file"
    return Verdict.FAIL, f"none answers at {where}: {said}", remedy
