"""Co-simulation: robots that move and a network that carries their packets, at one simulated time.

Scripts need two functions: `from sim_backends.cosim import load_scenario, build`. They are imported on first use, so
that a federate (a physics or network simulator) can import a module of this package without importing all others.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sim_backends.cosim.scenario.build import Simulation, build
    from sim_backends.cosim.scenario.loading import load_scenario

__all__ = ["Simulation", "build", "load_scenario"]

_MODULES: Final = {
    "Simulation": "sim_backends.cosim.scenario.build",
    "build": "sim_backends.cosim.scenario.build",
    "load_scenario": "sim_backends.cosim.scenario.loading",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 (the type depends on the name)
    if name not in _MODULES:
        raise AttributeError(f"module {__name__} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
