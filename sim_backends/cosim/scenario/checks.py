"""What is wrong with a scenario beyond what its file says by itself: its world, its robots, this machine."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from fieldkit.config.schema import Location
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.units import format_bytes
from sim_backends.cosim.scenario import memory
from sim_backends.cosim.scenario.motions import FollowPlan, StationKeepingPlan
from sim_backends.cosim.scenario.robots import antennas, bodies, limits, robots
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.speeds import beyond_limits
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.quadrotor import QuadrotorLimits
from sim_backends.world.world import World


class ScenarioRefusal(NamedTuple):
    """Why a scenario cannot be run.

    Attributes:
        place: Keys that lead to what is wrong.
        what: What is wrong.
        remedy: What to do about it.
    """

    place: Location
    what: str
    remedy: str


def refusals(scenario: CosimScenario, world: World) -> Iterator[ScenarioRefusal]:
    """Yield every reason for which a scenario cannot be run in its world."""
    yield from _memory(scenario)
    yield from _lines(scenario, world)
    yield from _robots(scenario)
    yield from _radios(scenario)
    yield from _starts(scenario, world)
    yield from _speeds(scenario, world)


def check(scenario: CosimScenario, world: World, where: Callable[[Location], str]) -> None:
    """Refuse a scenario that cannot be run.

    Args:
        scenario: The scenario.
        world: Its world.
        where: Tells where keys are.

    Raises:
        ConfigurationError: It cannot be run; the first reason, and where.
    """
    for refusal in refusals(scenario, world):
        raise ConfigurationError(refusal.what, where=where(refusal.place), remedy=refusal.remedy)


def _lines(scenario: CosimScenario, world: World) -> Iterator[ScenarioRefusal]:
    for name, plan in scenario.agents.items():
        if plan.along is not None and scenario.line not in world.lines:
            yield ScenarioRefusal(
                ("agents", name, "along"),
                f"the world {world.name} has no line {scenario.line} for {name} to start along",
                "give it at_m: [EAST, NORTH] instead",
            )


def _robots(scenario: CosimScenario) -> Iterator[ScenarioRefusal]:
    known = robots()
    for name, plan in scenario.agents.items():
        if plan.robot not in known:
            yield ScenarioRefusal(
                ("agents", name, "robot"),
                f"there is no robot {plan.robot!r}",
                nearest(plan.robot, known, f"robots: {', '.join(known)}"),
            )


def _radios(scenario: CosimScenario) -> Iterator[ScenarioRefusal]:
    stations = antennas(scenario)
    mute = ({name for pair in scenario.pairs for name in pair} | {scenario.relay}) - stations.keys()
    for name, plan in scenario.agents.items():
        if name in mute:
            yield ScenarioRefusal(
                ("agents", name),
                f"{name} sends, receives or relays and has no radio",
                f"{plan.robot} is a body only: add radio: {{standard: 802.11n, tx_power_dbm: 17}} to {name}, "
                f"or take a robot that has a profile",
            )


def _starts(scenario: CosimScenario, world: World) -> Iterator[ScenarioRefusal]:
    for name, plan in scenario.agents.items():
        if isinstance(limits(plan.robot), QuadrotorLimits):
            continue
        if plan.height:
            yield ScenarioRefusal(
                ("agents", name, "height"), f"{plan.robot} does not fly", f"leave the height of {name} out"
            )
        if isinstance(plan.motion, StationKeepingPlan):
            yield ScenarioRefusal(
                ("agents", name, "motion"), f"{plan.robot} does not fly, so that it keeps its station", "let it stand"
            )
        if isinstance(plan.motion, FollowPlan) and len(plan.motion.leader) > 1:
            yield ScenarioRefusal(
                ("agents", name, "motion", "leader"),
                f"{plan.robot} does not fly, so that it follows one leader only",
                f"name one of {', '.join(plan.motion.leader)}",
            )
    try:
        Bodies(bodies(scenario, world), world)
    except ConfigurationError as error:
        agent = error.what.partition(" ")[0]  # who begins in something, or in somebody
        yield ScenarioRefusal(("agents", agent), error.what, error.remedy)


def _speeds(scenario: CosimScenario, world: World) -> Iterator[ScenarioRefusal]:
    standing = bodies(scenario, world)
    for name, plan in scenario.agents.items():
        for place, what, asked, most, unit in beyond_limits(plan.motion, standing[name].place_m, limits(plan.robot)):
            yield ScenarioRefusal(
                ("agents", name, "motion", *place),
                f"{name} is asked for {what} of {asked:.6g} {unit}, and {plan.robot} does {most:.6g} {unit} at most",
                f"let it be slower, or take a robot that is faster than {plan.robot}",
            )


def _memory(scenario: CosimScenario) -> Iterator[ScenarioRefusal]:
    needed, available = memory.needed_bytes(scenario), memory.available_bytes()
    if available is not None and needed > available:
        what = (
            f"{scenario.duration:g} s of {len(scenario.agents):,} agents would take {format_bytes(needed)} of "
            f"memory, and {format_bytes(available)} are left"
        )
        if memory.radio_bytes(scenario) > available:
            yield ScenarioRefusal(("agents",), what, "have fewer agents")
            return
        most = max(scenario.traffic, key=lambda one: one.packets(scenario.duration), default=None)
        packets = 0.0 if most is None else most.packets(scenario.duration)
        yield ScenarioRefusal(
            ("duration",),
            what,
            "let it last shorter, or send less"
            + ("" if most is None else f": {most.title} alone has {packets:,.0f} packets"),
        )
