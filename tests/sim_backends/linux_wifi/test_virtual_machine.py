"""Linux's Wi-Fi in a virtual machine on our medium: one boot with a trial and several checks of the medium."""

import csv
import gzip
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
from sim_backends.linux_wifi import guest
from sim_backends.linux_wifi.virtual_machine import ROOT_VARIABLE, Kernel, require_machine, run_in_machine
from tests.helpers.paths import ROOT

# Without KVM two minutes on an idle machine; the clock of the machine does not depend on it.
BOOT_S = 1800.0
OPTIONS = ("--protocol", "udp", "--repeats", "1", "--record", "1s")
IMPORTED = ("fieldkit.cli.commands.trial", "fieldkit.cli.results", "fieldkit.trial.running.opening")
SITE = """\
backend: emulated
emulated: {wifi: linux, ros: builtin}
robots:
  ground-1: {profile: turtlebot3_burger}
  ground-2: {profile: turtlebot3_burger}
  ground-3: {profile: turtlebot3_burger}
roles:
  master: {sender: ground-1, receiver: ground-2, relay: ground-3}
"""


@pytest.fixture(scope="module", autouse=True)
def extracted_packages() -> Iterator[None]:
    """Use the packages that .ci/install extracts: with iw on the PATH, fieldkit samples links in other tests, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
        yield


@pytest.fixture(scope="module")
def kernel() -> Kernel:
    return require_machine()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("a lab")
    (path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    (path / "trials").mkdir()
    return path


@pytest.fixture(scope="module")
def results(kernel: Kernel, folder: Path) -> dict[str, Any]:
    # The machine cannot write compiled modules to the host, and would need a minute to compile them itself.
    for module in ("sim_backends.linux_wifi.medium_program", "sim_backends.emulated.robot.init", *IMPORTED):
        importlib.import_module(module)
    job = (sys.executable, str(Path(__file__).with_name("machine_job.py")), *OPTIONS)
    script = guest.prologue(folder) + f"export PYTHONDONTWRITEBYTECODE=1\nexec {shlex.join(job)}\n"
    result = run_in_machine(kernel, script, Deadline.after(BOOT_S), radios=3, results=folder / "trials")
    assert result.code == 0, result.output
    line = next(line for line in result.output.splitlines() if line.startswith("RESULTS "))
    measured: dict[str, Any] = json.loads(line.removeprefix("RESULTS "))
    return measured | {"output": result.output}


@pytest.fixture(scope="module")
def row(results: dict[str, Any], folder: Path) -> dict[str, str]:
    """The row of the trial's only repeat."""
    assert results["trial"] == 0, results["output"]
    (table,) = folder.glob("trials/*/trial.csv")
    (only_row,) = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    return only_row


def number(dump: str, label: str) -> int:
    """Return a number of `iw station dump`."""
    match = re.search(rf"{label}:\s*(-?\d+)", dump)
    assert match is not None, dump
    return int(match[1])


@pytest.mark.emulated
def test_a_trial_over_the_access_point_of_the_relay_is_valid(row: dict[str, str], folder: Path) -> None:
    assert (row["status"], row["topology"], row["file_loss"]) == ("valid", "master", "0")
    (links,) = folder.glob("trials/*/repeats/udp-01/sender-link.txt.gz")
    assert "SSID: fieldkit" in gzip.decompress(links.read_bytes()).decode()


@pytest.mark.emulated
def test_link_columns_are_those_of_iw(row: dict[str, str]) -> None:
    for role in ("sender", "receiver"):
        assert -90 < float(row[f"{role}_signal_median_dbm"]) < -30
        assert 1e6 <= float(row[f"{role}_tx_rate_bit_s"]) <= 72.2e6
        assert int(row[f"{role}_radio_tx_packets"]) >= 10
        assert int(row[f"{role}_tx_retries"]) >= 0


@pytest.mark.emulated
def test_times_of_an_emulated_processor_are_withheld_and_the_row_has_the_reason(row: dict[str, str]) -> None:
    assert row["backend"] == "emulated (wifi linux, clock instructions)"
    times = [name for name in row if name.endswith(("_s", "_ppm")) and not name.endswith("_rate_bit_s")]
    assert {"rtt_median_s", "transfer_s", "goodput_bit_s", "one_way_median_s"} <= set(times)
    assert [name for name in times if row[name]] == []


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
