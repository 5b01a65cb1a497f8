"""The check of preflight which connection to its autopilot a drone has, and which programs use it."""

import json
from collections.abc import Sequence

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role, Verdict
from fieldkit.core.text import JSON_ERRORS, harmless
from fieldkit.remote import agent
from fieldkit.steps import streams
from fieldkit.steps.scene import Need, Said

_KINDS = {
    "udpout": "UDP, the robot sends first",
    "udpin": "UDP, the autopilot sends first",
    "tcp": "TCP",
}
_SHARED = {True: "use it through the link server", False: "uses it through the link server"}


def link_need(robot: Robot, role: Role, connection: str, programs: Sequence[str]) -> Need:
    """Return the need of a connection to an autopilot that works.

    Args:
        robot: Whose programs use it.
        role: Its role.
        connection: The connection.
        programs: What the programs are: `pilot`, `guard`, `recorder`.
    """

    def judge(said: Said) -> tuple[Verdict, str, str]:
        return _judged(connection, programs, said)

    argv = streams.python(robot, agent.path_from_home(), "survey", streams.compact({"connection": connection}))
    return Need(role, "MAVLink", argv, judge, of=robot.profile.tools.python, agent=True)


def _judged(connection: str, programs: Sequence[str], said: Said) -> tuple[Verdict, str, str]:
    """Return whether the connection works, with its kind and its programs."""
    kind = _KINDS.get(connection.partition(":")[0], "serial line")
    users = f"{' and '.join(programs)} {_SHARED[len(programs) > 1]}"
    try:
        found = json.loads(said.text)
        error, system = harmless(found["error"]), int(found["system"])
        candidates = ", ".join(map(harmless, found["candidates"]))
    except JSON_ERRORS:
        last = harmless((said.text.splitlines() or ["no answer"])[-1]).removeprefix("error: ")
        return Verdict.FAIL, f"{connection} ({kind}): {last}", "mavlink.connection of the profile"
    there = f"this computer has {candidates}" if candidates else "this computer has no other one that is usual"
    remedy = f"{there}; write what the autopilot is at as mavlink.connection in the profile"
    if error:
        return Verdict.FAIL, f"{connection} ({kind}) cannot be opened: {error}", remedy
    if not system:
        return Verdict.FAIL, f"{connection} ({kind}): no heartbeat of an autopilot", remedy
    return Verdict.OK, f"{connection} ({kind}) reaches system {system}; {users}", ""
