"""The command `fieldkit cosim conform`, which checks that an external federate follows the protocol of federates.

A federate is a simulator of physics or network that takes part in a co-simulation.
"""

import argparse
import shlex
from functools import partial
from typing import Any

from fieldkit.cli.display import show_note
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.text import json_text, print_text
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.federates.conformance.probe import Target
from sim_backends.federates.conformance.suite import ConformanceResult, run_checks
from sim_backends.federates.frames import NETWORK, PHYSICS, ROLES
from sim_backends.federates.handshake import Hello
from sim_backends.federates.named import named_federate
from sim_backends.federates.protocols import FederateError
from sim_backends.federates.session import open_session
from sim_backends.world.world import load_world


def run(arguments: argparse.Namespace) -> int:
    """Run all checks of the federate's role, and print each failure with its request and answer.

    Returns:
        1 if a check failed, otherwise 0.

    Raises:
        FieldkitError: The federate cannot be started or connected, or the scenario is invalid.
    """
    endpoint = arguments.federate[0] if len(arguments.federate) == 1 else shlex.join(arguments.federate)
    deadline_s = settings.parse_deadline_s(arguments.deadline)
    changes = settings.read_changes(arguments)
    if _is_federate_with_role(endpoint, NETWORK):
        changes |= {"traffic": _udp_traffic(load_scenario(arguments.scenario, changes))}
    scenario = load_scenario(arguments.scenario, changes | _federate_change(endpoint))
    role, name = _role(endpoint, scenario, arguments.role, deadline_s)
    opener = partial(open_session, role, endpoint, deadline_s=deadline_s)
    target = Target(opener, _hello(scenario, role), arguments.windows)
    results = []
    for result in run_checks(target):
        results.append(result)
        if arguments.format == "table":
            _show(result)
    if arguments.format == "json":
        print_text(json_text([vars(result) for result in results], indent=2))
    failed = sum(bool(result.failure) for result in results)
    skipped = sum(bool(result.skipped) for result in results)
    passed = format_count(len(results) - failed - skipped, "check")
    show_note(f"{name}: {passed} passed, {skipped} not applicable, {failed} failed")
    return 1 if failed else 0


def _hello(scenario: CosimScenario, role: int) -> Hello:
    world = load_world(scenario.world)
    return make_hello(scenario, world, make_bodies(scenario, world), scenario.seeds[0], role)


def _role(endpoint: str, scenario: CosimScenario, requested_role: str | None, deadline_s: float) -> tuple[int, str]:
    """Return the role of a federate (the requested role, or the first that it accepts) and its name for messages.

    Raises:
        FieldkitError: The federate cannot be started or connected, or it accepts none of these roles.
    """
    roles = [role for role in (PHYSICS, NETWORK) if requested_role in {None, ROLES[role]}]
    if requested_role is None:
        roles = [role for role in roles if _is_federate_with_role(endpoint, role)] or roles
    for role in roles:
        try:
            session, _, _ = open_session(role, endpoint, _hello(scenario, role), deadline_s)
        except FederateError:
            if role == roles[-1]:
                raise
            continue
        session.close()
        return role, session.name
    raise FieldkitError(f"{endpoint} accepts no role", remedy="correct the command or --role")


def _federate_change(endpoint: str) -> dict[str, str]:
    """Return the change of a scenario that selects a named federate; the federate's options are then validated."""
    return {
        f"{ROLES[role]}.federate": endpoint for role in (PHYSICS, NETWORK) if _is_federate_with_role(endpoint, role)
    }


def _udp_traffic(scenario: CosimScenario) -> list[dict[str, Any]]:
    """Return the traffic with UDP instead of topics and ROS 1, because a network may not support these."""
    entries = [traffic.model_dump(mode="json", by_alias=True, exclude_none=True) for traffic in scenario.traffic]
    for entry in entries:
        if entry["protocol"] in {"topic", "ros1", "ros1-udp"}:
            entry["protocol"] = "udp"
            entry.pop("qos", None)
    return entries


def _is_federate_with_role(endpoint: str, role: int) -> bool:
    """Return True if there is a federate with this name and this role."""
    try:
        return named_federate(endpoint, role) is not None
    except ConfigurationError:  # the federate has only the other role, or its package cannot be loaded
        return False


def _show(result: ConformanceResult) -> None:
    state = "FAILED" if result.failure else "skipped" if result.skipped else "passed"
    print_text(f"{state:7}  {result.name}: {result.meaning}")
    for label, text in (
        ("", result.failure or result.skipped),
        ("request: ", result.request),
        ("answer:  ", result.answer),
    ):
        if text:
            print_text(f"         {label}{text}")
