"""The setups that reproduce the paper's simulations: shipped scenarios, and the changes for each row of a table.

Values that the paper does not state are those of the scenario's file and of the default radio: docs/studies/paper.md.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core.model import Scenario as Sight
from sim_backends.cosim.policies.window_policies import EventDriven, SlidingWindow, VelocityAware
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.flow_samples import Setup

Changes = Mapping[str, Any]
"""Changes of a scenario's file, as for `load_scenario`."""

RADIOS: Final[Mapping[str, Changes]] = MappingProxyType(
    {"wifi": MappingProxyType({}), "1 Mbit/s": MappingProxyType({"radio": {"rate": "1Mbit/s"}})}
)
"""Radios of the mesh: the one in its file, and fixed links as in EMANE's model RF Pipe."""

_DURATION: Final = "20s"
"""The run ends 9 s after the last packet of a bag; packets that are still under way then count as lost."""


def masterless(line: Sight, distance_m: float, changes: Changes, *, flying: bool = False) -> Setup:
    """Return the setup of a row of tables 1 and 2: a topic from one agent to another.

    Args:
        line: With line of sight or without.
        distance_m: Distance between the two along that line.
        changes: Changes that apply to all rows.
        flying: True if the drone sends, instead of a ground robot.
    """
    source, destination, moved = ("iris", "husky-1", "iris") if flying else ("husky-1", "husky-2", "husky-2")
    places = {f"agents.{moved}.along": f"{distance_m}m"}
    return Setup(_baylands(line, places | _bag(source, destination, "topic"), changes), VelocityAware.name)


def master_based(line: Sight, distance_m: float, protocol: str, changes: Changes) -> Setup:
    """Return the setup of a row of table 3: all packets pass the drone, which hovers halfway.

    Args:
        line: With line of sight or without.
        distance_m: Distance between the two ground robots along that line.
        protocol: `ros1` (TCP) or `ros1-udp`.
        changes: Changes that apply to all rows.
    """
    master = {
        "topology": "master",
        "relay": "iris",
        "agents.husky-2.along": f"{distance_m}m",
        "agents.iris.along": f"{distance_m / 2}m",
        "agents.iris.motion": {"kind": "station-keeping"},
    }
    return Setup(_baylands(line, master | _bag("husky-1", "husky-2", protocol), changes), SlidingWindow.name)


def mesh(radio: Changes, changes: Changes) -> Setup:
    """Return the setup of the experiment with EMANE. It is run exactly, as an emulator has no synchronization method.

    Args:
        radio: One of `RADIOS`.
        changes: Further changes.
    """
    return Setup(load_scenario("ten_node_mesh", {**radio, **changes}), EventDriven.name)


def the_flow(setup: Setup) -> str:
    """Return the name of the only flow of a setup."""
    (traffic,) = setup.scenario.traffic
    (flow,) = traffic.flows
    return flow


def _bag(source: str, destination: str, protocol: str) -> dict[str, Any]:
    return {"traffic": [{"kind": "bag", "from": source, "to": destination, "protocol": protocol, "start": "500ms"}]}


def _baylands(line: Sight, row_changes: Changes, changes: Changes) -> CosimScenario:
    return load_scenario("baylands", {"line": str(line), "duration": _DURATION, **row_changes, **changes})
