"""Meshes of babeld and batman-adv on Linux's Wi-Fi after a lab with WPA3: one boot.

Each mesh has three robots in a row, whose ends are out of range. `test_mesh_trials.py` has meshes in new machines.
"""

import importlib
import json
import re
import shlex
import sys
from typing import Any

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.telemetry.source_outputs import mesh_values
from sim_backends.emulated.linux_wifi import guest
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE, require_machine, run_in_machine
from sim_backends.emulated.robot.mesh_options import MeshOptions
from tests.helpers.paths import ROOT
from tests.sim_backends.emulated.linux_wifi import mesh_job

pytestmark = [pytest.mark.emulated, pytest.mark.nightly]

BOOT_S = 3600.0
# The machine cannot write compiled modules to the host, and would need minutes to compile them itself.
IMPORTED = (
    "sim_backends.emulated.robot.init",
    "sim_backends.emulated.robot.wireless",
    "sim_backends.emulated.linux_wifi.lab",
    "sim_backends.emulated.linux_wifi.medium_program",
)
FIRST_TTL = 64


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    for module in IMPORTED:
        importlib.import_module(module)
    job = (sys.executable, mesh_job.__file__)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
        kernel = require_machine(mesh=MeshOptions(protocol="batman-adv"))
        script = f"{guest.prologue(ROOT)}exec {shlex.join(job)}\n"
        result = run_in_machine(kernel, script, Deadline.after(BOOT_S), radios=3)
    assert result.code == 0, result.output
    line = next(line for line in result.output.splitlines() if line.startswith("RESULTS "))
    job_results: dict[str, Any] = json.loads(line.removeprefix("RESULTS "))
    assert job_results["WPA3 link"]
    assert "mode DORMANT" in job_results["WPA3 interface"]
    return job_results


@pytest.fixture
def babel(results: dict[str, Any]) -> dict[str, Any]:
    mesh: dict[str, Any] = results["babel"]
    return mesh


@pytest.fixture
def batman(results: dict[str, Any]) -> dict[str, Any]:
    mesh: dict[str, Any] = results["batman-adv"]
    return mesh


def ttls(ping_output: str) -> list[int]:
    """Return the time to live of each reply."""
    return [int(ttl) for ttl in re.findall(r"ttl=(\d+)", ping_output)]


def wifi_address(mesh: dict[str, Any], role: str) -> str:
    """Return the address of a robot's Wi-Fi interface."""
    match = re.search(r"^wlan0\s+\S+\s+(\S+)", mesh["addresses"][role], re.MULTILINE)
    assert match is not None, mesh["addresses"]
    return match[1]


def next_hop(originators: str, originator: str) -> str:
    """Return the best next hop in the list of originators of batman-adv."""
    match = re.search(rf"^ \* {originator}\s+\S+s\s+\(\s*\d+\)\s+(\S+)", originators, re.MULTILINE)
    assert match is not None, originators
    return match[1]


def test_babeld_forwards_packets_over_the_relay(babel: dict[str, Any]) -> None:
    assert babel["link"], babel
    replies = ttls(babel["ping"])
    assert len(replies) >= 16
    assert set(replies) == {FIRST_TTL - 1}
    assert "via 10.42.0.3" in babel["route"]
    assert "babeld" in babel["routing"].split()


def test_batman_forwards_frames_over_the_relay(batman: dict[str, Any]) -> None:
    """It forwards below IP, so the relay does not decrement the time to live."""
    assert batman["link"], batman
    replies = ttls(batman["ping"])
    assert len(replies) >= 16
    assert set(replies) == {FIRST_TTL}
    assert next_hop(batman["route"], wifi_address(batman, "receiver")) == wifi_address(batman, "relay")
    assert batman["routing"].split() == ["batman-adv"], "no babeld runs"


def test_the_telemetry_of_batctl_counts_the_neighbours_in_range(batman: dict[str, Any]) -> None:
    counts = {role: mesh_values(output)["neighbours"] for role, output in batman["telemetry"].items()}
    assert counts == {"sender": 1, "receiver": 1, "relay": 2}


@pytest.mark.parametrize("protocol", ["babel", "batman-adv"])
def test_the_loss_of_the_relay_is_reported_and_its_return_restores_the_route(
    results: dict[str, Any], protocol: str
) -> None:
    mesh = results[protocol]
    assert mesh["is lost"], mesh
    assert mesh["ping without relay"] == 0
    assert mesh["link again"], mesh
    assert mesh["is lost without radio"], mesh
    assert mesh["link with radio"], mesh


def test_babeld_changes_to_a_direct_route(babel: dict[str, Any]) -> None:
    assert babel["direct link"], babel
    assert "via 10.42.0.2" in babel["direct route"]
    assert set(ttls(babel["direct ping"])) == {FIRST_TTL}


def test_batman_changes_to_a_direct_route(batman: dict[str, Any]) -> None:
    assert batman["direct link"], batman
    receiver = wifi_address(batman, "receiver")
    assert next_hop(batman["direct route"], receiver) == receiver
