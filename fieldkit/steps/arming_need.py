"""The check of preflight whether the autopilot of a drone may be armed for a flight."""

import json
from dataclasses import asdict

from fieldkit.agent.flight_plan import FlightPlan
from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role, Verdict
from fieldkit.core.text import JSON_ERRORS, harmless
from fieldkit.remote import agent
from fieldkit.steps import streams
from fieldkit.steps.scene import Need, Said


def arming_need(robot: Robot, role: Role, plan: FlightPlan) -> Need:
    """Return the need of an autopilot that may be armed for this flight."""
    arguments = streams.compact({"connection": plan.connection, "needs": asdict(plan.needs)})
    argv = streams.python(robot, agent.path_from_home(), "arming", arguments)
    return Need(role, "autopilot", argv, _judged, of=robot.profile.tools.python, agent=True)


def _judged(said: Said) -> tuple[Verdict, str, str]:
    """Return whether an autopilot answers that can be armed for the flight; grave faults come first."""
    try:
        *faults, told = (json.loads(line) for line in said.text.splitlines())
        faults.sort(key=lambda fault: not fault["grave"])
        what, remedy = ("; ".join(harmless(fault[key]) for fault in faults) for key in ("what", "remedy"))
        name, charge = harmless(told["autopilot"]), told["charge"]
        has = f", its battery has {charge:.0%}" if charge is not None else ""
    except JSON_ERRORS:
        last = (said.text.splitlines() or ["it does not say why"])[-1]
        remedy = (
            "see that it has power, and that its messages reach mavlink.connection or mavlink.port of the profile"
        )
        return (
            Verdict.FAIL,
            harmless(last).removeprefix("error: "),
            f"{remedy} on the robot: mavlink-router, for example",
        )
    if not faults:
        return Verdict.OK, f"{name} says that it may be armed{has}", ""
    return (Verdict.FAIL if faults[0]["grave"] else Verdict.WARN), what, remedy
