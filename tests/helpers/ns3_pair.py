"""Two robots on open ground, with ns-3 or the built-in network."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.run_record import Fate, Run

SCENARIO: Final = """\
name: line
summary: two robots on open ground
world: open
duration: 500ms
policy: {name: sliding_window, window: 10ms}
radio: {fading: false, queue_packets: 20}
agents:
  ann: {robot: husky, at_m: [0, 0], radio: {standard: 802.11g}}
  bob: {robot: husky, at_m: [10, 0], radio: {standard: 802.11g}}
traffic:
  - {kind: stream, name: state, from: ann, to: bob, rate: 100Hz, size_bytes: 3000}
"""
RELAYED: Final = {
    "topology": "master",
    "relay": "hub",
    "agents.hub": {"robot": "husky", "at_m": [5, 5], "radio": {"standard": "802.11g"}},
}


def stream(**changes: object) -> list[dict[str, object]]:
    """Return the traffic of the scenario with changes."""
    state = {"kind": "stream", "name": "state", "from": "ann", "to": "bob", "rate": "100Hz", "size_bytes": 3000}
    return [state | changes]


def run_pair(folder: Path, network: str, changes: Mapping[str, Any]) -> Run:
    """Run the scenario with changes, and return the record."""
    path = folder / "line.yaml"
    path.write_text(SCENARIO, encoding="utf-8")
    with build(load_scenario(path, {"network.federate": network, **changes}), deadline_s=20.0) as simulation:
        return simulation.run()


def reasons(run: Run) -> Counter[str]:
    """Return the number of packets that did not arrive, by reason."""
    return Counter(fate.reason for fate in run.fates.values() if fate.arrived_ns is None)


def arrived(run: Run) -> list[Fate]:
    """Return the fates of the packets that arrived."""
    return [fate for fate in run.fates.values() if fate.arrived_ns is not None]
