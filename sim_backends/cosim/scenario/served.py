"""Serves the built-in physics or network as an external federate: a simulator in another process.

The command is `python -m sim_backends.cosim.scenario.served physics [ADDRESS]`, or `network` instead of `physics`.
ADDRESS is the address of a transport; without it, standard input and output are used.
"""

import json
import sys
from functools import partial
from typing import Any

from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.build import radio_network
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.federates.frames import NETWORK, PHYSICS, ROLES
from sim_backends.federates.handshake import Hello
from sim_backends.federates.serving import serve
from sim_backends.physics.bodies import Bodies
from sim_backends.world.world import World


def make_federate(role: int, hello: Hello) -> Any:  # noqa: ANN401 (a physics or network federate)
    """Return the built-in federate of a run.

    Args:
        role: `PHYSICS` or `NETWORK`.
        hello: The first message of a coordinator.

    Raises:
        ValidationError: The configuration is invalid.
    """
    configuration = json.loads(hello.configuration)
    scenario = CosimScenario.model_validate(configuration["scenario"])
    world = World.model_validate(configuration["world"])
    if role == PHYSICS:
        return Bodies(make_bodies(scenario, world), world, step_ns=hello.step_ns, lifetimes=scenario.lifetimes)
    return radio_network(scenario, world, hello.seed)


def main(role_name: str, address: str | None = None) -> None:
    """Serve the built-in federate of a role: `physics` or `network`."""
    role = PHYSICS if role_name == ROLES[PHYSICS] else NETWORK
    serve(partial(make_federate, role), address=address, name=f"fieldkit {ROLES[role]}", agents_disappear=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
