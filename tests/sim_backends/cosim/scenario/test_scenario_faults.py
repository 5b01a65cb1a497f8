"""The effects of faults in a scenario, and the measured recovery after them."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_backends.cosim.commands.results import recoveries
from sim_backends.cosim.federates import UnansweredError
from sim_backends.cosim.packet_columns import NEVER, columns, round_trips_s
from sim_backends.cosim.recording import packet_tables
from sim_backends.cosim.run_record import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.schema import CosimScenario

SCENARIO = """\
name: line
summary: three robots in a row
world: open
duration: 3s
radio: {fading: false}
agents:
  a: {robot: turtlebot3_burger, at_m: [10, 10]}
  b: {robot: turtlebot3_burger, at_m: [20, 10]}
  c: {robot: turtlebot3_burger, at_m: [30, 10]}
traffic:
  - {kind: stream, name: ab, from: a, to: b, rate: 100Hz}
  - {kind: stream, name: cb, from: c, to: b, rate: 100Hz}
  - {kind: ping, name: ping, from: a, to: c, count: 28, interval: 100ms}
faults:
"""
MS = 1_000_000
ALL_FLOWS = {"ab/b", "cb/b", "ping/c", "ping/c/reply"}


RunOf = Callable[..., tuple[CosimScenario, Run]]


@pytest.fixture
def run_of(tmp_path: Path) -> RunOf:
    """Return a function that runs the scenario with a fault, and optionally with changes."""

    def run(fault: str, changes: Mapping[str, Any] | None = None) -> tuple[CosimScenario, Run]:
        path = tmp_path / "line.yaml"
        path.write_text(SCENARIO + f"  - {fault}\n", encoding="utf-8")
        scenario = load_scenario(path, changes)
        return scenario, build(scenario).run()

    return run


def send_times_ms(run: Run, flow: str) -> list[float]:
    return [fate.packet.sent_ns / MS for (name, _), fate in run.fates.items() if name == flow]


def send_times_of_lost_ms(run: Run, flow: str) -> list[float]:
    """Return the times of sending, in ms, of the packets of a flow that never arrived."""
    return [fate.packet.sent_ns / MS for (name, _), fate in run.fates.items() if name == flow and fate.reason]


def are_within(times_ms: list[float], begin_ms: float, end_ms: float) -> bool:
    return all(begin_ms <= at_ms < end_ms for at_ms in times_ms)


def test_an_agent_that_is_off_sends_and_receives_nothing_and_recovers(run_of: RunOf) -> None:
    scenario, run = run_of("{kind: node-loss, agent: c, from: 1s, to: 2s}")
    assert not [at_ms for at_ms in send_times_ms(run, "cb/b") if 1000 <= at_ms < 2000]
    assert len(send_times_ms(run, "cb/b")) == pytest.approx(200, abs=1)
    assert not send_times_of_lost_ms(run, "ab/b")
    lost_times_ms = send_times_of_lost_ms(run, "ping/c")
    assert len(lost_times_ms) == 10
    assert are_within(lost_times_ms, 1000, 2000)
    recoveries_by_flow = {recovery.flow: recovery for recovery in recoveries(scenario, run)}
    assert recoveries_by_flow.keys() == ALL_FLOWS - {"ab/b"}
    lost_packets = {flow: recovery.lost_packets for flow, recovery in recoveries_by_flow.items()}
    assert lost_packets == {"cb/b": 0, "ping/c": 10, "ping/c/reply": 0}
    for flow, period_s in (("cb/b", 0.01), ("ping/c", 0.1), ("ping/c/reply", 0.1)):
        recovered_s = recoveries_by_flow[flow].recovered_s
        assert recovered_s is not None
        assert 0 < recovered_s < period_s + 0.01


@pytest.mark.parametrize("agent", ["b", "c"])
def test_a_rescheduled_timer_that_was_due_while_its_host_was_off_fires_when_the_host_is_on(
    run_of: RunOf, agent: str
) -> None:
    """The fault is during registration at the master, when every reply reschedules the timers of the connection."""
    ros1 = {"traffic.1.protocol": "ros1", "relay": "b"}
    _, run = run_of(f"{{kind: node-loss, agent: {agent}, from: 10ms, to: 500ms}}", ros1)
    late_fates = [fate for (flow, _), fate in run.fates.items() if flow == "cb/b" and fate.packet.sent_ns > 2500 * MS]
    assert len(late_fates) == pytest.approx(50, abs=1)
    assert not any(fate.reason for fate in late_fates)


TOPIC = {"traffic.1.protocol": "topic"}
DISCOVERED_MS = 200
"""Time at which discovery of publishers and subscribers is complete."""


def test_a_subscriber_that_was_off_for_less_than_a_lease_receives_the_history_of_its_writer(run_of: RunOf) -> None:
    scenario, run = run_of("{kind: node-loss, agent: b, from: 1s, to: 2s}", TOPIC)
    fates = [
        fate for (flow, _), fate in run.fates.items() if flow == "cb/b" and fate.packet.sent_ns > DISCOVERED_MS * MS
    ]
    lost_fates = [fate for fate in fates if fate.reason]
    assert {fate.reason for fate in lost_fates} == {"evicted from the writer's history before it was acknowledged"}
    assert are_within([fate.packet.sent_ns / MS for fate in lost_fates], 990, 1910)
    # The writer keeps the last ten samples; each arrives within a heartbeat period after b is on.
    delivered_fates = [fate for fate in fates if not fate.reason and 1000 * MS < fate.packet.sent_ns < 2000 * MS]
    assert len(lost_fates) + len(delivered_fates) == pytest.approx(100, abs=1)
    assert 9 <= len(delivered_fates) <= 10
    assert all(fate.arrived_ns is not None and 2000 < fate.arrived_ns / MS < 2120 for fate in delivered_fates)
    (recovery,) = (recovery for recovery in recoveries(scenario, run) if recovery.flow == "cb/b")
    assert recovery.lost_packets == pytest.approx(len(lost_fates), abs=1)


def test_a_topic_whose_publisher_was_off_loses_no_published_sample(run_of: RunOf) -> None:
    _, run = run_of("{kind: node-loss, agent: c, from: 1s, to: 2s}", TOPIC)
    assert len(send_times_ms(run, "cb/b")) == pytest.approx(200, abs=1)
    assert are_within(send_times_of_lost_ms(run, "cb/b"), 0, DISCOVERED_MS)


@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
def test_a_topic_removes_a_subscriber_whose_lease_has_expired_and_discovers_it_again(
    run_of: RunOf, reliability: str
) -> None:
    slow = {"duration": "40s", "traffic.0.rate": "1Hz", "traffic.1.rate": "10Hz"}
    qos = {"traffic.1.qos": {"reliability": reliability}}
    scenario, run = run_of("{kind: node-loss, agent: b, from: 5s, to: 20s}", TOPIC | slow | qos)
    (recovery,) = (recovery for recovery in recoveries(scenario, run) if recovery.flow == "cb/b")
    assert recovery.lost_packets == 150, "after a lease of 10 s no sample is kept for it"
    # Announcements are sent every 8 s; one that was due during the fault is sent when the agent is on again.
    assert recovery.recovered_s is not None
    assert 0 < recovery.recovered_s < 8.2
    lost_times_ms = [at_ms for at_ms in send_times_of_lost_ms(run, "cb/b") if at_ms > DISCOVERED_MS]
    assert are_within(lost_times_ms, 5000, 20_000 + 1000 * recovery.recovered_s)
    reasons = {fate.reason for (flow, _), fate in run.fates.items() if flow == "cb/b"}
    assert ("the lease of the subscriber expired" in reasons) == (reliability == "reliable")
    assert "not matched yet" in reasons


def test_a_cut_link_affects_both_ends_and_no_other_agent(run_of: RunOf) -> None:
    scenario, run = run_of("{kind: link-cut, between: [c, a], from: 500ms, to: 1500ms}")
    assert not send_times_of_lost_ms(run, "ab/b")
    assert not send_times_of_lost_ms(run, "cb/b")
    assert len(send_times_of_lost_ms(run, "ping/c")) == 10
    assert are_within(send_times_of_lost_ms(run, "ping/c"), 500, 1500)
    assert {recovery.flow for recovery in recoveries(scenario, run)} == {"ping/c", "ping/c/reply"}
    trips_s = round_trips_s(run, "ping/c")
    assert (trips_s.shape, np.isnan(trips_s).sum()) == ((28,), 10)
    assert np.nanmax(trips_s) < 0.02


def test_a_fault_of_the_relay_affects_all_flows_that_pass_it(run_of: RunOf) -> None:
    master = {"topology": "master", "relay": "b"}
    scenario, run = run_of("{kind: link-cut, between: [a, b], from: 500ms, to: 1500ms}", master)
    assert len(send_times_of_lost_ms(run, "ping/c")) == 10
    assert {recovery.flow for recovery in recoveries(scenario, run)} == ALL_FLOWS - {"cb/b"}
    scenario, run = run_of("{kind: node-loss, agent: b, from: 500ms, to: 1500ms}", master)
    assert len(send_times_of_lost_ms(run, "ping/c")) == 10
    assert {recovery.flow for recovery in recoveries(scenario, run)} == ALL_FLOWS


def test_a_jammer_affects_all_agents_and_without_an_end_has_no_recovery(run_of: RunOf) -> None:
    scenario, run = run_of("{kind: jammer, power_dbm: 60, at_m: [20, 12], from: 1s, to: 2s}")
    # Stations that sense the noise defer, so that packets that are not lost arrive late.
    arrived_ms = [fate.arrived_ns / MS for fate in run.fates.values() if fate.arrived_ns is not None]
    assert not [at_ms for at_ms in arrived_ms if 1010 < at_ms < 2000]
    measured_recoveries = recoveries(scenario, run)
    assert {recovery.flow for recovery in measured_recoveries} == ALL_FLOWS
    assert all(recovery.recovered_s is not None and recovery.recovered_s < 0.3 for recovery in measured_recoveries)
    scenario, run = run_of("{kind: jammer, power_dbm: 60, agent: b, from: 1s}")
    assert not recoveries(scenario, run)
    assert max(fate.arrived_ns or 0 for fate in run.fates.values()) < 1100 * MS


def test_a_fast_clock_sends_more(run_of: RunOf) -> None:
    _, reference = run_of("{kind: node-loss, agent: c, from: 2.9s}")
    _, run_with_fast_clock = run_of("{kind: clock-skew, agent: a, rate_ppm: 100000, from: 1s, to: 2s}")
    # For one second the sender runs at 110 Hz.
    assert len(send_times_ms(run_with_fast_clock, "ab/b")) - len(send_times_ms(reference, "ab/b")) == pytest.approx(
        0, abs=1
    )
    times_during_fault_ms = [at_ms for at_ms in send_times_ms(run_with_fast_clock, "ab/b") if 1000 <= at_ms < 2000]
    assert len(times_during_fault_ms) == pytest.approx(110, abs=1)
    # After it was set back by 100 ms, the program waits until the clock reaches the same reading again.
    assert not [at_ms for at_ms in send_times_ms(run_with_fast_clock, "ab/b") if 2000 <= at_ms < 2099]
    assert len([at_ms for at_ms in send_times_ms(run_with_fast_clock, "cb/b") if 1000 <= at_ms < 2000]) == 100


@pytest.mark.parametrize("federate", ["physics", "network"])
def test_a_federate_that_stalls_is_named_and_the_record_is_kept(tmp_path: Path, federate: str) -> None:
    path = tmp_path / "line.yaml"
    text = SCENARIO + f"  - {{kind: stalled-federate, federate: {federate}, from: 500ms, stall: 1min}}\n"
    path.write_text(text, encoding="utf-8")
    simulation = build(load_scenario(path), deadline_s=0.2)
    with pytest.raises(UnansweredError, match=f"{federate} has not answered for 0.2 s: request to advance from 0.4"):
        simulation.run()
    run = simulation.coordinator.run
    assert run.windows_ns[-1] == pytest.approx(500 * MS, rel=0.1)
    assert len(run.fates) > 90


def test_a_run_has_a_row_per_packet(run_of: RunOf) -> None:
    _, run = run_of("{kind: link-cut, between: [c, a], from: 500ms, to: 1500ms}")
    table = columns(run)
    names = (
        "flow number source destination protocol size_bytes sent_ns enters_ns arrived_ns counted_ns late_ns reason"
    )
    assert set(table) == set(names.split())
    assert set(table) <= set(packet_tables.SCHEMAS["packets"].names), "the columns of the recorded file"
    assert {len(column) for column in table.values()} == {len(run.fates)}
    for row, ((flow, number), fate) in enumerate(run.fates.items()):
        assert (table["flow"][row], table["number"][row]) == (flow, number)
        arrived_ns = NEVER if fate.arrived_ns is None else fate.arrived_ns
        assert (table["arrived_ns"][row], table["reason"][row]) == (arrived_ns, fate.reason)
        assert table["sent_ns"][row] == fate.packet.sent_ns
