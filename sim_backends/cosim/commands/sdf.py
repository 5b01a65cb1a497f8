"""The command `fieldkit cosim sdf`, which prints the world of a scenario for Gazebo."""

import argparse

from fieldkit.core.text import print_text
from sim_backends.cosim.commands import settings
from sim_backends.cosim.scenario.sdf_world import scenario_sdf


def run(arguments: argparse.Namespace) -> int:
    """Print the world with its robots as SDF."""
    print_text(scenario_sdf(settings.read_scenario(arguments), arguments.gazebo).rstrip("\n"))
    return 0
