"""WPA3, monitor interfaces, meshes, and roaming of Linux's Wi-Fi on fieldkit's medium: one boot."""

import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fieldkit.core.deadline import Deadline
from sim_backends.emulated.linux_wifi import guest
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE, require_machine, run_in_machine
from tests.helpers.paths import ROOT

pytestmark = [pytest.mark.emulated, pytest.mark.nightly]

BOOT_S = 1800.0


@pytest.fixture(scope="module", autouse=True)
def extracted_packages() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
        yield


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    job = (sys.executable, str(Path(__file__).with_name("variants_job.py")))
    result = run_in_machine(
        require_machine(), f"{guest.prologue(ROOT)}exec {shlex.join(job)}\n", Deadline.after(BOOT_S), radios=4
    )
    assert result.code == 0, result.output
    line = next(line for line in result.output.splitlines() if line.startswith("RESULTS "))
    job_results: dict[str, Any] = json.loads(line.removeprefix("RESULTS "))
    return job_results


def test_stations_join_with_sae_and_protected_management_frames(results: dict[str, Any]) -> None:
    assert results["wpa3 link"], results
    assert results["wpa3 stations"].count("authorized:\tyes") == 2
    assert results["wpa3 stations"].count("MFP:\t\tyes") == 2
    assert results["wpa3 ping"] >= 16


def test_the_monitor_interface_captures_frames_with_radiotap(results: dict[str, Any]) -> None:
    """Sent frames have no signal; received ones have a signal and a rate."""
    frames = results["frames"].splitlines()
    assert len(frames) == 20
    assert any(re.search(r"-\d+dBm signal", line) and re.search(r"\d Mb/s", line) for line in frames)
    assert any("dBm signal" not in line for line in frames)


def test_frames_that_were_lost_before_arrive_with_the_retry_flag(results: dict[str, Any]) -> None:
    """Encrypted frames with this flag are decrypted, because encryption does not protect it."""
    assert results["edge ping"] >= 10
    controls = [bytes.fromhex(control) for control, _, _ in results["edge frames"]]
    data = [control for control in controls if control[0] == 0x88]
    assert any(control[1] & 0x08 for control in data), results
    assert any(not control[1] & 0x08 for control in data), results


def test_frames_are_forwarded_in_the_mesh_by_the_robot_in_between(results: dict[str, Any]) -> None:
    assert results["mesh link"], results
    assert results["mesh ping"] >= 16
    assert all("type mesh point" in text for text in results["interfaces"].values())
    macs = {role: text.split("addr ")[1].split()[0] for role, text in results["interfaces"].items()}
    paths = [line.split()[:2] for line in results["paths"].splitlines()]
    assert [macs["receiver"], macs["relay"]] in paths, "the receiver is reached over the relay"


def test_the_mesh_has_no_path_without_the_relay_and_heals(results: dict[str, Any]) -> None:
    assert results["mesh without relay"] == 0
    assert results["mesh again"], results
    assert results["mesh after switching"], results


def test_a_station_roams_to_the_other_access_point_and_keeps_its_connections(results: dict[str, Any]) -> None:
    address_before, address_after = results["access point before"], results["access point after"]
    assert address_before
    assert address_after
    assert address_before != address_after
    assert re.search(rf"connected to {address_after}|roamed.* {address_after}", results["events"]), results["events"]
    assert results["link over the bridge"], results
    assert results["ping over the bridge"] >= 8
