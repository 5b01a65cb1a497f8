"""Linux's Wi-Fi in a virtual machine on our medium: one boot, several checks."""

import importlib
import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import TestbedLostError
from sim_backends.linux_wifi.virtual_machine import Kernel, require_machine, run_in_machine
from tests.helpers.paths import ROOT

ROOTS = (ROOT / ".linux", Path("/"))
# .ci/install extracts iw, because with iw on the PATH fieldkit samples links of all robots of other tests.
PROGRAMS = f"/usr/sbin:/usr/bin:/sbin:/bin:{ROOT / '.linux/sbin'}:{ROOT / '.linux/usr/sbin'}"
# Without KVM a minute on an idle machine; the clock of the machine does not depend on it.
BOOT_S = 1200.0


@pytest.fixture(scope="module")
def kernel() -> Kernel:
    return require_machine(ROOTS, PROGRAMS)


@pytest.fixture(scope="module")
def results(kernel: Kernel) -> dict[str, Any]:
    # The machine cannot write the compiled files that it needs.
    importlib.import_module("sim_backends.linux_wifi.medium_program")
    job = Path(__file__).with_name("machine_job.py")
    script = f"""\
cd {shlex.quote(str(ROOT))}
export PATH={shlex.quote(PROGRAMS)} TMPDIR=/run
export PYTHONPATH=. PYTHONDONTWRITEBYTECODE=1 OPENBLAS_NUM_THREADS=1
exec {shlex.join((sys.executable, str(job)))}
"""
    result = run_in_machine(kernel, script, Deadline.after(BOOT_S), radios=4, memory_mib=512)
    assert result.code == 0, result.output
    line = next(line for line in result.output.splitlines() if line.startswith("RESULTS "))
    measured: dict[str, Any] = json.loads(line.removeprefix("RESULTS "))
    return measured


def number(dump: str, label: str) -> int:
    """Return a number of `iw station dump`."""
    match = re.search(rf"{label}:\s*(-?\d+)", dump)
    assert match is not None, dump
    return int(match[1])


@pytest.mark.emulated
def test_robots_of_an_ad_hoc_network_reach_each_other_only_in_range(results: dict[str, Any]) -> None:
    assert results["ad_hoc"], results
    assert results["near"] >= 8
    assert results["far"] == 0
    assert results["near_again"], results


@pytest.mark.emulated
def test_the_driver_of_the_robot_shows_what_the_medium_reported(results: dict[str, Any]) -> None:
    dump, totals = results["dump_and_totals"]
    assert number(dump, "tx packets") == totals["frames"]
    assert number(dump, "tx retries") == totals["reported_tries"] - totals["frames"]
    assert number(dump, "tx failed") == totals["frames"] - totals["acknowledged"] >= 1
    # Without fading the signal is the same in both directions.
    assert number(dump, "signal") == totals["signal_dbm"]


@pytest.mark.emulated
def test_a_station_joins_an_access_point_with_wpa2(results: dict[str, Any]) -> None:
    assert results["wpa2"], results["logs"]
    assert "SSID: lab" in results["station_link"]
    assert "authorized:\tyes" in results["access_point"]


@pytest.mark.emulated
def test_without_the_medium_nothing_arrives_until_it_is_restarted(results: dict[str, Any]) -> None:
    """hwsim would deliver all frames without loss if the registered socket were closed."""
    assert results["without_medium"] == 0
    assert results["restarted"], results


@pytest.mark.emulated
def test_the_kernel_accepts_the_messages_of_the_medium(results: dict[str, Any]) -> None:
    counts = results["counts"]
    assert (counts["rejected"], counts["overruns"]) == (0, 0)


@pytest.mark.emulated
def test_a_machine_that_does_not_end_in_time_is_removed(kernel: Kernel) -> None:
    with pytest.raises(TestbedLostError, match="did not switch off in time"):
        run_in_machine(kernel, "true", Deadline.after(0.5), radios=1)
