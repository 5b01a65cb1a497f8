"""Robots with Linux's Wi-Fi on fieldkit's medium, in a virtual machine: one boot, several checks."""

import importlib
import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import TestbedLostError
from sim_backends.emulated.linux_wifi import guest
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE, Kernel, require_machine, run_in_machine
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

# Without KVM, the boot takes a minute on an idle host.
BOOT_S = 1800.0
IMPORTED = (
    "fieldkit.config.profiles",
    "sim_backends.emulated.running_robots",
    "sim_backends.emulated.robot.init",
    "sim_backends.emulated.linux_wifi.lab",
    "sim_backends.emulated.linux_wifi.medium_program",
)


@pytest.fixture(scope="module", autouse=True)
def extracted_packages() -> Iterator[None]:
    """Use the packages that .ci/install extracts; if iw were on the PATH, other tests would sample links, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
        yield


@pytest.fixture(scope="module")
def kernel() -> Kernel:
    return require_machine()


@pytest.fixture(scope="module")
def results(kernel: Kernel) -> dict[str, Any]:
    # The machine cannot write compiled modules to the host, and would need a minute to compile them itself.
    for module in IMPORTED:
        importlib.import_module(module)
    job = (sys.executable, str(Path(__file__).with_name("machine_job.py")))
    script = guest.prologue(ROOT) + f"export PYTHONDONTWRITEBYTECODE=1\nexec {shlex.join(job)}\n"
    result = run_in_machine(kernel, script, Deadline.after(BOOT_S), radios=3)
    assert result.code == 0, result.output
    line = next(line for line in result.output.splitlines() if line.startswith("RESULTS "))
    job_results: dict[str, Any] = json.loads(line.removeprefix("RESULTS "))
    return job_results


def number(dump: str, label: str) -> int:
    """Return a number of `iw station dump`."""
    match = re.search(rf"{label}:\s*(-?\d+)", dump)
    assert match is not None, dump
    return int(match[1])


def test_stations_join_the_access_point_of_the_relay_with_wpa2(results: dict[str, Any]) -> None:
    assert results["access_point"].count("authorized:\tyes") == 2
    assert "SSID: fieldkit" in results["link"]


def test_robots_reach_each_other_only_in_range(results: dict[str, Any]) -> None:
    assert results["near"] >= 8
    assert results["far"] == 0
    assert results["near_again"], results


def test_counters_of_the_driver_equal_those_of_the_medium(results: dict[str, Any]) -> None:
    dump_before, totals_before, dump, totals = results["dumps_and_totals"]

    def increase(label: str) -> int:
        return number(dump, label) - number(dump_before, label)

    frames = totals["frames"] - totals_before["frames"]
    assert increase("tx packets") == frames >= 10
    assert increase("tx retries") == totals["reported_tries"] - totals_before["reported_tries"] - frames
    assert increase("tx failed") == frames - (totals["acknowledged"] - totals_before["acknowledged"])
    # Without fading the signal is the same in both directions.
    assert number(dump, "signal") == totals["signal_dbm"]


@pytest.mark.parametrize("state", ["suspended", "killed"])
def test_no_packet_arrives_without_the_medium(results: dict[str, Any], state: str) -> None:
    """hwsim would deliver all frames without loss if the registered socket were closed."""
    assert results[state] == 0


def test_a_suspended_medium_continues_and_a_killed_one_is_reported_and_replaced(results: dict[str, Any]) -> None:
    assert results["continued"], results
    assert "SIGKILL" in results["error"]
    assert results["restarted"], results


def test_the_kernel_accepts_the_messages_of_the_medium(results: dict[str, Any]) -> None:
    counts = results["counts"]
    assert (counts["rejected"], counts["overruns"]) == (0, 0)


def test_the_radios_return_when_the_robots_stop(results: dict[str, Any]) -> None:
    assert len(results["radios"]) == 3


def test_a_machine_that_does_not_exit_in_time_is_killed(kernel: Kernel) -> None:
    with pytest.raises(TestbedLostError, match="did not switch off in time"):
        run_in_machine(kernel, "true", Deadline.after(0.5), radios=1)
