"""Jammers in ns-3 have the effects that they have in the built-in network."""

from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.packet_ledger import fixed_emitters_m, transmitters
from tests.helpers.ns3_pair import SCENARIO, arrived, reasons, run_pair, stream

MS = 1_000_000
NETWORKS = ("builtin", "ns3")
STEP_MS, STEPS = 60, 16
"""Power rises by 1 dB per step."""


def loss_power_dbm(folder: Path, network: str, mode: str, first_dbm: int) -> float:
    """Return the power of a jammer beside the receiver at which half of the packets are lost."""
    faults = [
        {
            "kind": "jammer",
            "power_dbm": first_dbm + step,
            "at_m": [30, 6],
            "height": "0.5m",
            "from": f"{STEP_MS * (step + 1)}ms",
            "to": f"{STEP_MS * (step + 2)}ms",
        }
        for step in range(STEPS)
    ]
    run = run_pair(
        folder,
        network,
        {
            "duration": f"{STEP_MS * (STEPS + 2)}ms",
            "agents.bob.at_m": [30, 0],
            "radio.mode": mode,
            "radio.queue_packets": 1000,
            "faults": faults,
            "traffic": stream(rate="500Hz", size_bytes=600),
        },
    )
    sent_counts: Counter[int] = Counter()
    received_counts: Counter[int] = Counter()
    for fate in run.fates.values():
        step = fate.packet.sent_ns // (STEP_MS * MS) - 1
        sent_counts[step] += 1
        received_counts[step] += fate.arrived_ns is not None
    shares = [received_counts[step] / sent_counts[step] for step in range(STEPS)]
    for step, (share_before, share_after) in enumerate(pairwise(shares)):
        if share_before >= 0.5 > share_after:
            return first_dbm + step + (share_before - 0.5) / (share_before - share_after)
    raise AssertionError(f"no power at which half of the packets are lost: {shares}")


@pytest.mark.parametrize(("mode", "first_dbm"), [("g54", -34), ("g24", -24), ("g6", -16)])
def test_packets_are_lost_above_the_same_jammer_power_within_1_db(mode: str, first_dbm: int, tmp_path: Path) -> None:
    """The noise of both is Gaussian, and their error rates are those of the same model."""
    builtin_dbm, ns3_dbm = (loss_power_dbm(tmp_path, network, mode, first_dbm) for network in NETWORKS)
    assert ns3_dbm == pytest.approx(builtin_dbm, abs=1.0)


@pytest.mark.parametrize("network", NETWORKS)
def test_a_station_does_not_send_while_it_receives_strong_noise(network: str, tmp_path: Path) -> None:
    jammer = {"kind": "jammer", "power_dbm": 20, "at_m": [0, 3], "from": "100ms", "to": "200ms"}
    changes = {"duration": "400ms", "faults": [jammer], "traffic": stream(size_bytes=300)}
    run = run_pair(tmp_path, network, changes)
    assert reasons(run).total() <= 1, "the last packet may be under way"
    deferred_fates = [fate for fate in arrived(run) if 101 * MS < fate.packet.sent_ns < 199 * MS]
    assert len(deferred_fates) >= 9
    assert all(200 * MS <= (fate.arrived_ns or 0) < 240 * MS for fate in deferred_fates)


@pytest.mark.parametrize("network", NETWORKS)
def test_an_agent_carries_a_jammer_while_it_is_present(network: str, tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        "duration": "400ms",
        "agents.eve": {"robot": "husky", "at_m": [0, 3], "disappears": "200ms"},
        "faults": [{"kind": "jammer", "power_dbm": 20, "agent": "eve", "from": "100ms"}],
        "traffic": stream(size_bytes=300),
    }
    times_ns = sorted(fate.arrived_ns or 0 for fate in arrived(run_pair(tmp_path, network, changes)))
    assert not [at_ns for at_ns in times_ns if 102 * MS < at_ns < 200 * MS]
    assert len([at_ns for at_ns in times_ns if at_ns <= 102 * MS]) >= 9
    assert len([at_ns for at_ns in times_ns if at_ns >= 200 * MS]) >= 28


def test_jammers_are_announced_to_policies_that_bound_errors(tmp_path: Path) -> None:
    path = tmp_path / "line.yaml"
    path.write_text(SCENARIO, encoding="utf-8")
    jammer = {"kind": "jammer", "power_dbm": 0, "from": "0s"}
    changes = {
        "world": "baylands",
        "agents.eve": {"robot": "husky", "at_m": [40, 10]},
        "faults": [jammer | {"at_m": [78, 30], "height": "2m"}, jammer | {"agent": "eve"}],
    }
    emitters_by_network = []
    for network in NETWORKS:
        with build(load_scenario(path, {"network.federate": network, **changes})) as simulation:
            emitters_by_network.append((transmitters(simulation.network), fixed_emitters_m(simulation.network)))
    assert emitters_by_network[0] == emitters_by_network[1]
    ((_, _, up_m),) = emitters_by_network[0][1]
    assert up_m > 2, "the jammer is on raised ground"
