"""Preflight check that the autopilot of a drone can be armed for a flight."""

import json
from dataclasses import asdict

from fieldkit.agent.flying.flight_plan import FlightPlan
from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role, Verdict
from fieldkit.core.text import JSON_ERRORS, sanitized
from fieldkit.remote import agent
from fieldkit.steps import agent_commands
from fieldkit.steps.scene import CommandResult, Need


def arming_need(robot: Robot, role: Role, plan: FlightPlan) -> Need:
    """Return the preflight check that an autopilot can be armed for this flight."""
    arguments = agent_commands.compact({"connection": plan.connection, "needs": asdict(plan.needs)})
    argv = agent_commands.python(robot, agent.path_from_home(), "arming", arguments)
    return Need(role, "autopilot", argv, _judge, required_program=robot.profile.tools.python, agent=True)


def _judge(result: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the output of the agent's `arming`; severe faults come first."""
    try:
        *faults, status = (json.loads(line) for line in result.text.splitlines())
        faults.sort(key=lambda fault: not fault["grave"])
        what, remedy = ("; ".join(sanitized(fault[key]) for fault in faults) for key in ("what", "remedy"))
        name, charge = sanitized(status["autopilot"]), status["charge"]
        battery = f", its battery has {charge:.0%}" if charge is not None else ""
    except JSON_ERRORS:
        last_line = (result.text.splitlines() or ["the program printed nothing"])[-1]
        remedy = (
            "check its power, and that its messages reach mavlink.connection or mavlink.port of the profile on the "
            "robot, for example by mavlink-router"
        )
        return Verdict.FAIL, sanitized(last_line).removeprefix("error: "), remedy
    if not faults:
        return Verdict.OK, f"{name} reports that it can be armed{battery}", ""
    return (Verdict.FAIL if faults[0]["grave"] else Verdict.WARN), what, remedy
