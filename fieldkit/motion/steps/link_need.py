"""Preflight check of the connection between a drone's computer and its autopilot, and of the programs that use it."""

import json
from collections.abc import Sequence

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role, Verdict
from fieldkit.core.text import JSON_ERRORS, sanitized
from fieldkit.remote import agent
from fieldkit.steps import agent_commands
from fieldkit.steps.scene import CommandResult, Need

_KINDS = {
    "udpout": "UDP, the robot sends first",
    "udpin": "UDP, the autopilot sends first",
    "tcp": "TCP",
}
_LINK_SERVER_TEXTS = {True: "use it through the link server", False: "uses it through the link server"}
"""End of the sentence about the programs that use the connection; True for several programs. The link server is the
program on the robot that shares the connection among them."""


def link_need(robot: Robot, role: Role, connection: str, programs: Sequence[str]) -> Need:
    """Return the preflight check of the connection to an autopilot.

    Args:
        robot: The robot whose programs use the connection.
        role: Role of the robot.
        connection: The connection, such as `udpout:127.0.0.1:14550`.
        programs: Names of the programs: `pilot`, `guard`, `recorder`.
    """

    def judge(result: CommandResult) -> tuple[Verdict, str, str]:
        return _judge(connection, programs, result)

    argv = agent_commands.python(
        robot, agent.path_from_home(), "survey", agent_commands.compact({"connection": connection})
    )
    return Need(role, "MAVLink", argv, judge, required_program=robot.profile.tools.python, agent=True)


def _judge(connection: str, programs: Sequence[str], result: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the output of the agent's `survey`."""
    kind = _KINDS.get(connection.partition(":")[0], "serial line")
    users = f"{' and '.join(programs)} {_LINK_SERVER_TEXTS[len(programs) > 1]}"
    try:
        survey = json.loads(result.text)
        error, system = sanitized(survey["error"]), int(survey["system"])
        candidates = ", ".join(map(sanitized, survey["candidates"]))
    except JSON_ERRORS:
        last_line = sanitized((result.text.splitlines() or ["no answer"])[-1]).removeprefix("error: ")
        return Verdict.FAIL, f"{connection} ({kind}): {last_line}", "correct mavlink.connection of the profile"
    computer = "the robot's computer"
    available = f"{computer} has {candidates}" if candidates else f"{computer} has no other common connection"
    remedy = f"{available}; write the connection of the autopilot as mavlink.connection in the profile"
    if error:
        return Verdict.FAIL, f"{connection} ({kind}) cannot be opened: {error}", remedy
    if not system:
        return Verdict.FAIL, f"{connection} ({kind}): no heartbeat from an autopilot", remedy
    return Verdict.OK, f"{connection} ({kind}) reaches system {system}; {users}", ""
