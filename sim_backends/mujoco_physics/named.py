"""The physics federate `mujoco`, which is declared as an entry point; MuJoCo is imported when it is used."""

import sys

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.answering import FederateService
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.named import PythonFederate
from sim_backends.federates.simulator_options import SimulatorOptions


def load() -> FederateService:
    """Import MuJoCo, and return the federate.

    Raises:
        ConfigurationError: MuJoCo is not installed, or cannot be loaded.
    """
    try:
        from sim_backends.mujoco_physics.physics import SERVICE  # noqa: PLC0415 (it is not always installed)
    except ImportError as error:
        raise ConfigurationError(
            f"the mujoco physics federate needs the Python package mujoco: {error}",
            remedy=f"{sys.executable} -m pip install 'fieldkit[mujoco]'",
        ) from error
    return SERVICE


class MujocoOptions(SimulatorOptions):
    """The physics simulator [MuJoCo](mujoco.md) has no options."""


MUJOCO = PythonFederate(PHYSICS, load, "MuJoCo: robots with wheels and rotors, ground and contacts", MujocoOptions)
