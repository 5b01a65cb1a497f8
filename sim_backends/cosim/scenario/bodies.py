"""The bodies of a scenario's agents."""

from fieldkit.core.model import Vector
from sim_backends.cosim.scenario.motions import WayPointsPlan
from sim_backends.cosim.scenario.schema import AgentPlan, CosimScenario
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import Motion, WayPoints
from sim_backends.world.world import World

_ANTENNA_M = 0.2


def physics(scenario: CosimScenario, world: World) -> Paths:
    """Return what moves the agents."""
    motions = [_motion(name, agent, start_m(agent, scenario, world)) for name, agent in scenario.agents.items()]
    return Paths(motions, step_ns=scenario.physics.step_ns)


def _motion(name: str, agent: AgentPlan, begin_m: Vector) -> Motion:
    plan = agent.motion
    if not isinstance(plan, WayPointsPlan):
        return WayPoints(name, [begin_m], 1.0)
    return WayPoints(name, [begin_m, *way_m(plan, begin_m)], plan.speed)


def way_m(plan: WayPointsPlan, begin_m: Vector) -> list[Vector]:
    """Return the points of a way, metres east, north, up."""
    from_m = begin_m if plan.relative else (0.0, 0.0, 0.0)
    return [
        (from_m[0] + east_m, from_m[1] + north_m, from_m[2] + up_m[0] if up_m else begin_m[2])
        for east_m, north_m, *up_m in plan.points_m
    ]


def start_m(agent: AgentPlan, scenario: CosimScenario, world: World) -> Vector:
    """Return where an agent starts: metres east, north, up."""
    place_m = agent.at_m
    if place_m is None:
        assert agent.along is not None
        place_m = world.lines[scenario.line].at(agent.along, agent.aside_m)
    return *place_m, world.ground_m(place_m) + (agent.height or _ANTENNA_M)
