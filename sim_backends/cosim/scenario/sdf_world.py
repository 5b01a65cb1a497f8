"""Converts the world and the robots of a scenario to SDF, for Gazebo."""

from sim_backends.cosim.scenario.agent_setup import limits_of, make_bodies
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.gazebo.sdf import SdfRobot, Version, world_sdf
from sim_backends.physics.bodies import Bodies
from sim_backends.world.world import load_world


def scenario_sdf(scenario: CosimScenario, version: Version = "fortress") -> str:
    """Return an SDF file with the scenario's obstacles and with its robots at their starts.

    Args:
        scenario: The scenario.
        version: Version of Gazebo, which determines the names of the plugins.

    Raises:
        ConfigurationError: The world does not exist or is invalid, or a robot starts within an obstacle or within
            another robot.
    """
    world = load_world(scenario.world)
    scenario_bodies = make_bodies(scenario, world)
    states = Bodies(scenario_bodies, world, lifetimes=scenario.lifetimes).start_states()
    robots = {}
    for name, plan in scenario.agents.items():
        east_m, north_m, up_m = states[name].position_m
        place_m = (east_m, north_m, up_m - scenario_bodies[name].antenna_m)
        robots[name] = SdfRobot(limits_of(plan.robot), place_m, states[name].heading_rad or 0.0)
    return world_sdf(world, robots, step_ns=scenario.physics.step_ns, version=version)
