"""Checks of a scenario that need more than its file: its world, its robots, this machine."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from fieldkit.config.schema import Location
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.units import format_bytes
from sim_backends.cosim.scenario import memory
from sim_backends.cosim.scenario.motions import FollowPlan, StationKeepingPlan
from sim_backends.cosim.scenario.robots import antennas, bodies, limits, robots
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.speeds import excesses
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.quadrotor import QuadrotorLimits
from sim_backends.world.world import World


class ScenarioProblem(NamedTuple):
    """A reason why a scenario cannot be run.

    Attributes:
        location: Keys of the wrong value.
        message: What is wrong.
        remedy: How to correct it.
    """

    location: Location
    message: str
    remedy: str


def problems(scenario: CosimScenario, world: World) -> Iterator[ScenarioProblem]:
    """Yield every reason why a scenario cannot be run in its world."""
    yield from _memory(scenario)
    yield from _lines(scenario, world)
    yield from _robots(scenario)
    yield from _radios(scenario)
    yield from _starts(scenario, world)
    yield from _speeds(scenario, world)


def check(scenario: CosimScenario, world: World, where: Callable[[Location], str]) -> None:
    """Check that a scenario can be run.

    Args:
        scenario: The scenario.
        world: Its world.
        where: Returns the place of keys in the scenario's file, for the message.

    Raises:
        ConfigurationError: It cannot be run; the message has the first reason and its place.
    """
    for problem in problems(scenario, world):
        raise ConfigurationError(problem.message, where=where(problem.location), remedy=problem.remedy)


def _lines(scenario: CosimScenario, world: World) -> Iterator[ScenarioProblem]:
    for name, plan in scenario.agents.items():
        if plan.along is not None and scenario.line not in world.lines:
            yield ScenarioProblem(
                ("agents", name, "along"),
                f"the world {world.name} has no line {scenario.line} for {name} to start along",
                "give it at_m: [EAST, NORTH] instead",
            )


def _robots(scenario: CosimScenario) -> Iterator[ScenarioProblem]:
    robot_names = robots()
    for name, plan in scenario.agents.items():
        if plan.robot not in robot_names:
            yield ScenarioProblem(
                ("agents", name, "robot"),
                f"there is no robot {plan.robot!r}",
                did_you_mean(plan.robot, robot_names, f"robots: {', '.join(robot_names)}"),
            )


def _radios(scenario: CosimScenario) -> Iterator[ScenarioProblem]:
    stations = antennas(scenario)
    without_radio = ({name for pair in scenario.pairs for name in pair} | {scenario.relay}) - stations.keys()
    for name, plan in scenario.agents.items():
        if name in without_radio:
            yield ScenarioProblem(
                ("agents", name),
                f"{name} sends, receives or relays and has no radio",
                f"{plan.robot} is a body only: add radio: {{standard: 802.11n, tx_power_dbm: 17}} to {name}, "
                f"or choose a robot that has a profile",
            )


def _starts(scenario: CosimScenario, world: World) -> Iterator[ScenarioProblem]:
    for name, plan in scenario.agents.items():
        if isinstance(limits(plan.robot), QuadrotorLimits):
            continue
        if plan.height:
            yield ScenarioProblem(
                ("agents", name, "height"), f"{plan.robot} does not fly", f"remove the height of {name}"
            )
        if isinstance(plan.motion, StationKeepingPlan):
            yield ScenarioProblem(
                ("agents", name, "motion"),
                f"{plan.robot} does not fly, and only robots that fly keep their station",
                "remove its motion",
            )
        if isinstance(plan.motion, FollowPlan) and len(plan.motion.leader) > 1:
            yield ScenarioProblem(
                ("agents", name, "motion", "leader"),
                f"{plan.robot} does not fly, and only robots that fly follow several leaders",
                f"name one of {', '.join(plan.motion.leader)}",
            )
    try:
        Bodies(bodies(scenario, world), world)
    except ConfigurationError as error:
        agent = error.what.partition(" ")[0]  # the message begins with the name of the agent
        yield ScenarioProblem(("agents", agent), error.what, error.remedy)


def _speeds(scenario: CosimScenario, world: World) -> Iterator[ScenarioProblem]:
    bodies_at_start = bodies(scenario, world)
    for name, plan in scenario.agents.items():
        start_m = bodies_at_start[name].place_m
        for excess in excesses(plan.motion, start_m, limits(plan.robot)):
            yield ScenarioProblem(
                ("agents", name, "motion", *excess.location),
                f"{name} has {excess.quantity} of {excess.value:.6g} {excess.unit}, and {plan.robot} reaches "
                f"{excess.limit:.6g} {excess.unit} at most",
                f"choose a lower value, or a robot that is faster than {plan.robot}",
            )


def _memory(scenario: CosimScenario) -> Iterator[ScenarioProblem]:
    needed, available = memory.needed_bytes(scenario), memory.available_bytes()
    if available is not None and needed > available:
        message = (
            f"{scenario.duration:g} s of {len(scenario.agents):,} agents would need {format_bytes(needed)} of "
            f"memory, and {format_bytes(available)} are available"
        )
        if memory.radio_bytes(scenario) > available:
            yield ScenarioProblem(("agents",), message, "use fewer agents")
            return
        largest = max(scenario.traffic, key=lambda traffic: traffic.packets(scenario.duration), default=None)
        packets = 0.0 if largest is None else largest.packets(scenario.duration)
        yield ScenarioProblem(
            ("duration",),
            message,
            "choose a shorter duration, or send less"
            + ("" if largest is None else f": {largest.title} alone has {packets:,.0f} packets"),
        )
