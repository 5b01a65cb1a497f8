"""Checks of a scenario that need more than its file: the world, the robots, and the memory of this machine."""

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from fieldkit.config.schema import Location
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Topology, Vector
from fieldkit.core.units import format_bytes
from sim_backends.cosim.scenario.agent_plans import (
    FollowPlan,
    LegPlan,
    StationKeepingPlan,
    VelocityProfilePlan,
    WayPointsPlan,
)
from sim_backends.cosim.scenario.agent_setup import antennas_of, limits_of, list_robots, make_bodies, path_points_m
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.robot_limits import DriveLimits, QuadrotorLimits
from sim_backends.radio.radio_options import INFRASTRUCTURE
from sim_backends.world.world import World

PACKET_BYTES: Final = 1200
"""Size of the record of a packet: 1000 to 1130 bytes were measured over 20,000 packets of `baylands`."""
WINDOW_BYTES: Final = 40
"""Size of the record of a window: an integer and its entry in a list."""
PAIR_BYTES: Final = 1600
"""Memory of the radio per pair of stations: 1540 to 1660 bytes were measured with 100 to 300 stations."""
EVENTS_PER_PACKET: Final = 10
"""Largest number of windows per packet if each network event ends a window; 7 were measured with `baylands`."""

MEMINFO: Final = Path("/proc/meminfo")


def needed_bytes(scenario: CosimScenario) -> int:
    """Return the approximate maximum memory that a run needs for its record and its radio, with any policy."""
    windows = scenario.duration / scenario.physics.step + scenario.packets * EVENTS_PER_PACKET
    return round(scenario.packets * PACKET_BYTES + windows * WINDOW_BYTES) + radio_bytes(scenario)


def radio_bytes(scenario: CosimScenario) -> int:
    """Return the approximate maximum memory of the radio, which is proportional to the number of pairs of agents."""
    return 0 if scenario.radio.is_fixed else math.comb(len(scenario.agents), 2) * PAIR_BYTES


def available_bytes() -> int | None:
    """Return the available memory of this machine; None if the system does not report it."""
    try:
        lines = MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


Limits = DriveLimits | QuadrotorLimits


class Demand(NamedTuple):
    """A speed or rate that a motion requires, and the limit of the body.

    Attributes:
        location: Keys of the value in the scenario.
        quantity: Name of the quantity, with its article.
        value: The required value.
        limit: The largest value that the body reaches.
        unit: Unit of `value` and `limit`.
    """

    location: Location
    quantity: str
    value: float
    limit: float
    unit: str


_ROUNDING = 1e-9
"""A smaller excess over a limit, as a share of the limit, is a rounding error."""


def excesses(motion: object, start_m: Vector, limits: Limits) -> Iterator[Demand]:
    """Yield the demands of a motion that exceed the limits of a body.

    Args:
        motion: The motion of an agent in its scenario.
        start_m: Its start position, metres east, north, up.
        limits: The limits of its body.
    """
    for demand in _demands(motion, start_m, limits):
        if demand.value > demand.limit * (1 + _ROUNDING):
            yield demand


def _demands(motion: object, start_m: Vector, limits: Limits) -> Iterator[Demand]:
    if isinstance(motion, WayPointsPlan):
        yield Demand(("speed",), "a speed", motion.speed, limits.speed_m_s, "m/s")
        if isinstance(limits, QuadrotorLimits):
            yield from _climb_demands(motion, start_m, limits)
    elif isinstance(motion, VelocityProfilePlan):
        for number, leg in enumerate(motion.legs):
            for demand in _leg_demands(leg, limits):
                yield demand._replace(location=("legs", number, *demand.location))


def _leg_demands(leg: LegPlan, limits: Limits) -> Iterator[Demand]:
    yield Demand(("speed",), "a speed", abs(leg.speed), limits.speed_m_s, "m/s")
    turn_deg_s = abs(float(leg.turn_deg_s))
    if isinstance(limits, QuadrotorLimits):
        yield _climb_demand(("climb_m_s",), float(leg.climb_m_s), limits)
        yield Demand(("turn_deg_s",), "a rate of turn", turn_deg_s, 0.0, "deg/s")  # a quadrotor keeps its heading
    else:
        yield Demand(("turn_deg_s",), "a rate of turn", turn_deg_s, math.degrees(limits.turn_rad_s), "deg/s")
        yield Demand(("climb_m_s",), "a climb rate", abs(float(leg.climb_m_s)), 0.0, "m/s")


def _climb_demands(motion: WayPointsPlan, start_m: Vector, limits: QuadrotorLimits) -> Iterator[Demand]:
    for here_m, there_m in pairwise([start_m, *path_points_m(motion, start_m)]):
        length_m = math.dist(here_m, there_m)
        if length_m:
            yield _climb_demand(("speed",), motion.speed * (there_m[2] - here_m[2]) / length_m, limits)


def _climb_demand(location: Location, up_m_s: float, limits: QuadrotorLimits) -> Demand:
    down_limit_m_s, up_limit_m_s = limits.climb_m_s
    if up_m_s < 0:
        return Demand(location, "a sink rate", -up_m_s, down_limit_m_s, "m/s")
    return Demand(location, "a climb rate", up_m_s, up_limit_m_s, "m/s")


class ScenarioProblem(NamedTuple):
    """A reason why a scenario cannot be run.

    Attributes:
        location: Keys of the invalid value.
        message: The error.
        remedy: The correction.
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
    yield from _infrastructure(scenario)
    yield from _starts(scenario, world)
    yield from _speeds(scenario, world)


def check(scenario: CosimScenario, world: World, where: Callable[[Location], str]) -> None:
    """Check that a scenario can be run.

    Args:
        scenario: The scenario.
        world: Its world.
        where: Returns the place of a value for the message, for example its line in the file, from its keys.

    Raises:
        ConfigurationError: The scenario cannot be run; the message has the first reason and its place.
    """
    for problem in problems(scenario, world):
        raise ConfigurationError(problem.message, where=where(problem.location), remedy=problem.remedy)


def _lines(scenario: CosimScenario, world: World) -> Iterator[ScenarioProblem]:
    """Yield a problem for each agent that starts along a line which the world does not have."""
    for name, plan in scenario.agents.items():
        if plan.along is not None and scenario.line not in world.lines:
            yield ScenarioProblem(
                ("agents", name, "along"),
                f"the world {world.name} has no line {scenario.line} for {name} to start along",
                "give it at_m: [EAST, NORTH] instead",
            )


def _robots(scenario: CosimScenario) -> Iterator[ScenarioProblem]:
    """Yield a problem for each agent whose robot does not exist."""
    robot_names = list_robots()
    for name, plan in scenario.agents.items():
        if plan.robot not in robot_names:
            yield ScenarioProblem(
                ("agents", name, "robot"),
                f"there is no robot {plan.robot!r}",
                did_you_mean(plan.robot, robot_names, f"robots: {', '.join(robot_names)}"),
            )


def _radios(scenario: CosimScenario) -> Iterator[ScenarioProblem]:
    """Yield a problem for each agent that needs a radio and has none."""
    stations = antennas_of(scenario)
    agents_without_radio = ({name for pair in scenario.pairs for name in pair} | {scenario.relay}) - stations.keys()
    for name, plan in scenario.agents.items():
        if name in agents_without_radio:
            yield ScenarioProblem(
                ("agents", name),
                f"{name} sends, receives or relays packets, but has no radio",
                f"{plan.robot} is a body only: add radio: {{standard: 802.11n, tx_power_dbm: 17}} to {name}, "
                f"or choose a robot that has a profile",
            )


def _infrastructure(scenario: CosimScenario) -> Iterator[ScenarioProblem]:
    """Yield a problem if the infrastructure (such as access points) contradicts the rest of the scenario."""
    radio = scenario.radio
    if not radio.has_infrastructure:
        return
    from sim_backends.radio.infrastructure import infrastructure  # noqa: PLC0415 (other scenarios do not need it)

    has_relay = scenario.topology is Topology.MASTER
    if problem := infrastructure.conflict(radio, antennas_of(scenario), has_relay=has_relay):
        yield ScenarioProblem(("radio",), problem, "change radio or the agents of the scenario")
    if scenario.network.federate is not None:
        key = next(key for key in INFRASTRUCTURE if getattr(radio, key))
        yield ScenarioProblem(
            ("radio", key), f"an external network has no {key}", "remove it, or the external network"
        )


def _starts(scenario: CosimScenario, world: World) -> Iterator[ScenarioProblem]:
    """Yield a problem if an agent on wheels has a start or motion that needs flight, or a start is in an obstacle."""
    for name, plan in scenario.agents.items():
        if isinstance(limits_of(plan.robot), QuadrotorLimits):
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
                f"choose one of {', '.join(plan.motion.leader)}",
            )
    try:
        Bodies(make_bodies(scenario, world), world, lifetimes=scenario.lifetimes)
    except ConfigurationError as error:
        agent = error.what.partition(" ")[0]  # the message begins with the name of the agent
        yield ScenarioProblem(("agents", agent), error.what, error.remedy)


def _speeds(scenario: CosimScenario, world: World) -> Iterator[ScenarioProblem]:
    """Yield a problem for each speed or rate that a body cannot reach."""
    bodies_at_start = make_bodies(scenario, world)
    for name, plan in scenario.agents.items():
        start_m = bodies_at_start[name].place_m
        for excess in excesses(plan.motion, start_m, limits_of(plan.robot)):
            yield ScenarioProblem(
                ("agents", name, "motion", *excess.location),
                f"{name} has {excess.quantity} of {excess.value:.6g} {excess.unit}, but {plan.robot} reaches at most "
                f"{excess.limit:.6g} {excess.unit}",
                f"choose a lower value, or a robot that is faster than {plan.robot}",
            )


def _memory(scenario: CosimScenario) -> Iterator[ScenarioProblem]:
    """Yield a problem if a run needs more memory than is available."""
    needed, available = needed_bytes(scenario), available_bytes()
    if available is not None and needed > available:
        message = (
            f"{scenario.duration:g} s of {len(scenario.agents):,} agents would need {format_bytes(needed)} of "
            f"memory, but only {format_bytes(available)} are available"
        )
        if radio_bytes(scenario) > available:
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
