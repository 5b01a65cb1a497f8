"""Agents that appear and disappear during a run: packets, programs, positions, recordings, with every sync policy."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.packet_ledger import ABSENT
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.cosim.recording.recorder import StateSamples
from sim_backends.cosim.run_record import Fate, Run
from sim_backends.cosim.scenario.schema import CosimScenario

SCENARIO = """\
name: visitor
summary: a robot that is there between 1 s and 2 s
world: open
duration: 3s
radio: {fading: false}
agents:
  a: {robot: turtlebot3_burger, at_m: [10, 10]}
  b: {robot: turtlebot3_burger, at_m: [20, 10]}
  c:
    robot: turtlebot3_burger
    at_m: [30, 10]
    motion: {kind: velocity-profile, legs: [{duration: 5s, speed: 0.2m/s}]}
    appears: 1s
    disappears: 2s
traffic:
  - {kind: stream, name: ab, from: a, to: b, rate: 41Hz}
  - {kind: stream, name: ac, from: a, to: c, rate: 100Hz}
  - {kind: stream, name: cb, from: c, to: b, rate: 100Hz}
  - {kind: ping, name: ping, from: b, to: c, count: 28, interval: 100ms}
  - {kind: stream, name: bulk, from: b, to: c, rate: 20Hz, size_bytes: 1000, protocol: tcp}
  - {kind: stream, name: topic, from: a, to: c, rate: 10Hz, protocol: topic}
"""
S, MS = 10**9, 10**6
BEGIN_NS, END_NS = 1 * S, 2 * S


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "visitor.yaml"
    file.write_text(SCENARIO, encoding="utf-8")
    return file


def run_of(path: Path, policy: str, changes: Mapping[str, Any] | None = None) -> Run:
    with build(load_scenario(path, changes), policy=policy) as simulation:
        return simulation.run()


def flow(run: Run, name: str) -> list[Fate]:
    return [fate for (flow_name, _), fate in run.fates.items() if flow_name == name]


def is_there(at_ns: int) -> bool:
    return BEGIN_NS <= at_ns < END_NS


def check_fates(run: Run) -> None:
    """Check each packet from and to the agent."""
    with_c = [fate for fate in run.fates.values() if "c" in (fate.packet.source, fate.packet.destination)]
    assert not any(fate.packet.source == "c" and not is_there(fate.packet.sent_ns) for fate in with_c)
    for fate in with_c:
        if not is_there(fate.packet.sent_ns):
            assert fate.reason == ABSENT
        if fate.arrived_ns is not None:
            assert is_there(fate.arrived_ns)
    assert all(fate.is_decided for fate in with_c)
    assert not any(fate.reason == ABSENT for fate in flow(run, "ab/b"))
    lost = Counter(name for (name, _), fate in run.fates.items() if fate.reason and is_there(fate.packet.sent_ns))
    assert lost["ac/c"] + lost["cb/b"] <= 8, "only those that were under way"
    assert len(flow(run, "cb/b")) == pytest.approx(100, abs=1)
    assert len(flow(run, "ac/c")) == pytest.approx(300, abs=1)
    for name in ("ping/c/reply", "bulk/c", "topic/c"):
        assert any(fate.arrived_ns is not None for fate in flow(run, name)), name


@pytest.mark.parametrize("policy", sorted({*BUILTIN} - {"velocity_aware_raw"}))
def test_packets_from_and_to_an_absent_agent_are_dropped_with_every_policy(policy: str, path: Path) -> None:
    check_fates(run_of(path, policy, {"policy.window": "5ms", "policy.longest": "20ms"}))


def test_exact_policies_agree(path: Path) -> None:
    runs = [run_of(path, policy) for policy in ("event_driven", "variable_stepped")]
    assert runs[0].fates == runs[1].fates


def states_of(scenario: CosimScenario, policy: str = "event_driven") -> dict[str, list[int]]:
    samples = StateSamples()
    build(scenario, policy=policy, recorder=samples).run()
    times_ns: dict[str, list[int]] = {}
    for at_ns, name, _ in samples.states:
        times_ns.setdefault(name, []).append(at_ns)
    return times_ns


def test_states_are_those_of_present_agents(path: Path) -> None:
    times_ns = states_of(load_scenario(path))
    assert min(times_ns["a"]) == 0
    assert all(is_there(at_ns) for at_ns in times_ns["c"])
    assert len(times_ns["c"]) >= 9
