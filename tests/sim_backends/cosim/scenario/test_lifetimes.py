"""Agents that appear and disappear during a run: packets, programs, positions, recordings, with every sync policy."""

import json
import shlex
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from fieldkit.core.errors import FieldkitError
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.packet_ledger import ABSENT
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.cosim.recording.recorder import StateSamples
from sim_backends.cosim.run_record import Fate, Run
from sim_backends.cosim.scenario.schema import CosimScenario
from tests.helpers.federate_examples import EXAMPLES
from tests.helpers.runs import cosim

SCENARIO = """\
name: visitor
summary: a robot that exists between 400 ms and 900 ms
world: open
duration: 1200ms
radio: {fading: false}
agents:
  a: {robot: turtlebot3_burger, at_m: [10, 10]}
  b: {robot: turtlebot3_burger, at_m: [20, 10]}
  c:
    robot: turtlebot3_burger
    at_m: [30, 10]
    motion: {kind: velocity-profile, legs: [{duration: 5s, speed: 0.2m/s}]}
    appears: 400ms
    disappears: 900ms
traffic:
  - {kind: stream, name: ab, from: a, to: b, rate: 41Hz}
  - {kind: stream, name: ac, from: a, to: c, rate: 100Hz}
  - {kind: stream, name: cb, from: c, to: b, rate: 100Hz}
  - {kind: ping, name: ping, from: b, to: c, count: 24, interval: 50ms}
  - {kind: stream, name: bulk, from: b, to: c, rate: 50Hz, size_bytes: 1000, protocol: tcp}
  - {kind: stream, name: topic, from: a, to: c, rate: 20Hz, protocol: topic}
"""
MS = 10**6
BEGIN_NS, END_NS = 400 * MS, 900 * MS


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "visitor.yaml"
    file.write_text(SCENARIO, encoding="utf-8")
    return file


def run_scenario(path: Path, policy: str, changes: Mapping[str, Any] | None = None) -> Run:
    with build(load_scenario(path, changes), policy=policy) as simulation:
        return simulation.run()


def fates_of_flow(run: Run, name: str) -> list[Fate]:
    return [fate for (flow_name, _), fate in run.fates.items() if flow_name == name]


def is_present(at_ns: int) -> bool:
    return BEGIN_NS <= at_ns < END_NS


def check_fates(run: Run) -> None:
    """Check each packet from or to agent c."""
    fates_of_c = [fate for fate in run.fates.values() if "c" in (fate.packet.source, fate.packet.destination)]
    assert not any(fate.packet.source == "c" and not is_present(fate.packet.sent_ns) for fate in fates_of_c)
    for fate in fates_of_c:
        if not is_present(fate.packet.sent_ns):
            assert fate.reason == ABSENT
        if fate.arrived_ns is not None:
            assert is_present(fate.arrived_ns)
    assert all(fate.is_decided for fate in fates_of_c)
    assert not any(fate.reason == ABSENT for fate in fates_of_flow(run, "ab/b"))
    lost_counts = Counter(
        name for (name, _), fate in run.fates.items() if fate.reason and is_present(fate.packet.sent_ns)
    )
    assert lost_counts["ac/c"] + lost_counts["cb/b"] <= 8, "only those that were under way"
    assert len(fates_of_flow(run, "cb/b")) == pytest.approx(50, abs=1)
    assert len(fates_of_flow(run, "ac/c")) == pytest.approx(120, abs=1)
    flows = {name for name, _ in run.fates} - {"ab/b", "ac/c", "cb/b"}
    for name in flows:
        assert any(fate.arrived_ns is not None for fate in fates_of_flow(run, name)), name


@pytest.mark.parametrize("policy", sorted({*BUILTIN} - {"velocity_aware_raw"}))
def test_packets_from_and_to_an_absent_agent_are_dropped_with_every_policy(policy: str, path: Path) -> None:
    check_fates(run_scenario(path, policy, {"policy.window": "5ms", "policy.longest": "20ms"}))


def test_exact_policies_agree(path: Path) -> None:
    runs = [run_scenario(path, policy) for policy in ("event_driven", "variable_stepped")]
    assert runs[0].fates == runs[1].fates


def state_times_ns(scenario: CosimScenario, policy: str = "event_driven") -> dict[str, list[int]]:
    samples = StateSamples()
    build(scenario, policy=policy, recorder=samples).run()
    times_ns: dict[str, list[int]] = {}
    for at_ns, name, _ in samples.states:
        times_ns.setdefault(name, []).append(at_ns)
    return times_ns


def test_only_present_agents_have_states(path: Path) -> None:
    times_ns = state_times_ns(load_scenario(path))
    assert min(times_ns["a"]) == 0
    assert all(is_present(at_ns) for at_ns in times_ns["c"])
    assert len(times_ns["c"]) == 5


SERVE_COMMAND = shlex.join((sys.executable, "-m", "sim_backends.cosim.scenario.served"))
CARTS = shlex.join((sys.executable, str(EXAMPLES / "carts.py")))
WITHOUT_TOPIC = [
    {"kind": "stream", "name": "ab", "from": "a", "to": "b", "rate": "41Hz"},
    {"kind": "stream", "name": "ac", "from": "a", "to": "c", "rate": "100Hz"},
    {"kind": "stream", "name": "cb", "from": "c", "to": "b", "rate": "100Hz"},
    {"kind": "ping", "name": "ping", "from": "b", "to": "c", "count": 24, "interval": "50ms"},
    {"kind": "stream", "name": "bulk", "from": "b", "to": "c", "rate": "50Hz", "size_bytes": 1000, "protocol": "tcp"},
]
SIMPLE_NETWORK = """\
from sim_backends.federates.serving import serve
from sim_backends.network.disc import Disc
serve(lambda hello: Disc(1000.0, 100_000))
"""


@pytest.mark.parametrize("policy", ["event_driven", "error_bounded"])
def test_the_built_in_federates_give_the_same_events_as_processes(policy: str, path: Path) -> None:
    external = {f"{role}.federate": f"{SERVE_COMMAND} {role}" for role in ("physics", "network")}
    assert run_scenario(path, policy, external).digest == run_scenario(path, policy).digest


@pytest.mark.parametrize(
    "changes",
    [
        {"physics.federate": "mujoco"},
        {"physics.federate": CARTS},
        {"network.federate": "ns3", "traffic": WITHOUT_TOPIC},
        {"physics.federate": "mujoco", "network.federate": "ns3", "traffic": WITHOUT_TOPIC},
    ],
    ids=["mujoco", "carts", "ns3", "mujoco and ns3"],
)
def test_fates_are_the_same_with_external_federates(changes: Mapping[str, Any], path: Path) -> None:
    check_fates(run_scenario(path, "sliding_window", {"policy.window": "5ms", **changes}))


def test_absent_agents_need_no_support_of_the_network(path: Path, tmp_path: Path) -> None:
    program = tmp_path / "net.py"
    program.write_text(SIMPLE_NETWORK, encoding="utf-8")
    check_fates(run_scenario(path, "event_driven", {"network.federate": shlex.join((sys.executable, str(program)))}))


@pytest.mark.parametrize("physics", ["builtin", "mujoco"])
def test_an_agent_appears_at_its_start_and_moves_from_then_on(physics: str, path: Path) -> None:
    with build(load_scenario(path, {"physics.federate": physics})) as simulation:
        states_of_c = []
        for at_ns in range(50 * MS, 900 * MS, 50 * MS):
            simulation.run(at_ns)
            states_of_c.append(simulation.agents.states(at_ns).get("c"))
    assert states_of_c[:7] == [None] * 7
    assert [round(state.position_m[0], 2) for state in states_of_c[7:9] if state] == [30.0, 30.0]
    assert states_of_c[-1] is not None
    assert 30.03 < states_of_c[-1].position_m[0] < 30.1


@pytest.mark.parametrize("physics", ["builtin", "mujoco"])
def test_an_absent_agent_is_no_obstacle(physics: str, path: Path) -> None:
    """A robot drives through the place of an agent that has disappeared, and collides with one that is present."""
    motion = {"kind": "velocity-profile", "legs": [{"duration": "5s", "speed": "1m/s"}]}
    changes = {
        "physics.federate": physics,
        "traffic": [],
        "duration": "4s",
        "agents.a": {"robot": "husky", "at_m": [28.5, 10], "motion": motion, "radio": {}},
        "agents.c.robot": "husky",
        "agents.c.motion": {"kind": "standing"},
        "agents.c.radio": {},
    }
    eastings_m = {}
    for disappears in ("900ms", "4s"):
        with build(
            load_scenario(path, {**changes, "agents.c.disappears": disappears}), policy="sliding_window"
        ) as simulation:
            simulation.run()
            eastings_m[disappears] = simulation.agents.states(4000 * MS)["a"].position_m[0]
    assert eastings_m["900ms"] > 31.5
    assert eastings_m["4s"] < eastings_m["900ms"] - 0.2, "the robot stops, or pushes the other robot"


def test_a_run_with_lifetimes_can_be_recorded_and_replayed(path: Path) -> None:
    result = cosim(path.parent, "run", path.name, "--out", "run", "--format", "json")
    assert result.code == 0, result.err
    replayed = cosim(path.parent, "replay", "run", "--format", "json")
    assert replayed.code == 0, replayed.err
    assert json.loads(replayed.out) == json.loads(result.out)
    assert {file.stem for file in (path.parent / "run" / "captures").iterdir()} == {"a", "b", "c"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents.c.disappears": "300ms"}, "the agent disappears at 0.3 s, but appears only at 0.4 s"),
        ({"agents.c.at_m": [20, 10], "agents.c.motion": {"kind": "standing"}}, "c starts within b"),
    ],
)
def test_an_impossible_lifetime_is_an_error(changes: Mapping[str, Any], message: str, path: Path) -> None:
    with pytest.raises(FieldkitError, match=message):
        run_scenario(path, "event_driven", changes)
