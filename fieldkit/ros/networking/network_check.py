"""`fieldkit check --ros`: search for known reasons why ROS programs on several robots do not reach each other.

The checks run in the order in which a person would search: the settings of each robot, their agreement, and the
datagrams that arrive. Every `fieldkit check` also checks clock, power save and signal.
"""

from collections.abc import Mapping
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Role
from fieldkit.core.threads import run_parallel
from fieldkit.ros.networking import reachability, settings, state
from fieldkit.ros.networking.exchange import exchange
from fieldkit.ros.networking.state import RosState
from fieldkit.steps.scene import Shells
from fieldkit.trial.check.report import Report
from fieldkit.trial.plan import Plan

_CHECK: Final = "ROS network"


def check_network(plan: Plan, shells: Shells, reports: Mapping[Role, Report]) -> None:
    """Add the findings on the ROS network of the robots: the entry point `ros` of `fieldkit.fleet_checks`.

    A robot whose profile has no ROS gets only a note.

    Args:
        plan: The plan of a trial.
        shells: Connections to the robots that answer.
        reports: The report of each robot, to which the findings are added.
    """
    cast = {role: robot for role, robot in plan.cast.items() if role in shells and robot.profile.ros is not None}
    for role in shells:
        if role not in cast:
            reports[role].ok(_CHECK, "its profile has no ROS")
    states: dict[Role, RosState] = {}

    def read_state(role: Role) -> None:
        try:
            states[role] = state.read(cast[role], shells[role])
        except FieldkitError as error:
            reports[role].fail(_CHECK, error.what, error.remedy)

    run_parallel(read_state, cast)
    states = {role: states[role] for role in cast if role in states}
    for role, robot_state in states.items():
        settings.judge_robot(cast[role], robot_state, reports[role])
    settings.judge_agreement(cast, states, reports)
    settings.judge_servers(cast, states, reports)
    _check_reachability({role: cast[role] for role in states}, states, plan.trial, shells, reports)


def _check_reachability(
    cast: Cast,
    states: Mapping[Role, RosState],
    trial: str,
    shells: Shells,
    reports: Mapping[Role, Report],
) -> None:
    if len(cast) < 2:
        return
    domain = min((settings.domain(robot_state.variables) or 0 for robot_state in states.values()), default=0)
    for (source, destination), arrivals in exchange(cast, shells, domain, trial).items():
        ros2 = settings.is_ros2(cast[source]) and settings.is_ros2(cast[destination])
        reachability.judge_arrivals(
            cast[source], arrivals, states[destination], domain, reports[destination], ros2=ros2
        )
    for role in cast:
        if not settings.is_ros2(cast[role]):
            try:
                reachability.judge_names(role, cast, states, shells[role], reports[role])
            except FieldkitError as error:
                reports[role].fail(_CHECK, error.what, error.remedy)
