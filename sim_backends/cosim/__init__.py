"""Co-simulation: robots that move and a network that carries their packets, at one simulated time.

What a script needs stands here: `from sim_backends.cosim import load_scenario, build`. It is imported when
it is asked for, so that a federate may import its neighbours without everything else.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sim_backends.cosim.scenario.build import Simulation, build
    from sim_backends.cosim.scenario.loading import load_scenario

__all__ = ["Simulation", "build", "load_scenario"]

_WHERE: Final = {
    "Simulation": "sim_backends.cosim.scenario.build",
    "build": "sim_backends.cosim.scenario.build",
    "load_scenario": "sim_backends.cosim.scenario.loading",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 (whatever the module has by that name)
    if name not in _WHERE:
        raise AttributeError(f"module {__name__} has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), name)
