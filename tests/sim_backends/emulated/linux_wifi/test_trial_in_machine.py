"""Trials with Linux's Wi-Fi in the virtual machine, as a user runs them; results are on the host."""

import csv
import gzip
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fieldkit.cli import main
from fieldkit.measure.captures import pcap, radiotap
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE
from tests.helpers.paths import ROOT

pytestmark = [pytest.mark.emulated, pytest.mark.nightly]

SITE = """\
backend: emulated
emulated: {wifi: linux, ros: builtin, linux_wifi: {SETTINGS}}
robots:
  ground-1: {profile: turtlebot3_burger}
  ground-2: {profile: turtlebot3_burger}
  ground-3: {profile: turtlebot3_burger}
roles:
  master: {sender: ground-1, receiver: ground-2, relay: ground-3}
"""
SETTINGS = {
    "wpa2": "security: wpa2",
    "wpa3": "security: wpa3, monitor: true",
    "mesh": "mesh: true, monitor: true",
}
WITH_MONITOR = {"wpa3", "mesh"}
"""Settings with which the procedure captures on the monitor interfaces, too."""


@dataclass(frozen=True)
class Trial:
    """A trial with one repeat.

    Attributes:
        settings: One of `SETTINGS`.
        row: The row of the repeat.
        files: Folder of its files.
    """

    settings: str
    row: dict[str, str]
    files: Path


def run_trial(folder: Path, settings: str) -> Trial:
    (folder / "fieldkit.yaml").write_text(SITE.replace("SETTINGS", SETTINGS[settings]), encoding="utf-8")
    if settings in WITH_MONITOR:
        text = (ROOT / "procedures/los.yaml").read_text(encoding="utf-8")
        text = text.replace("- capture:\n", "- capture:\n      monitor: mon0\n")
        (folder / "procedures").mkdir()
        (folder / "procedures/los.yaml").write_text(text, encoding="utf-8")
    assert main(["trial", "los", "30ft", "--protocol", "udp", "--repeats", "1", "--record", "1s"]) == 0
    (table,) = folder.glob("trials/*/trial.csv")
    (row,) = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    return Trial(settings, row, table.parent / "repeats/udp-01")


@pytest.fixture(scope="module", params=list(SETTINGS))
def trial(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Trial:
    """A trial in a folder with a name that needs quoting."""
    path = tmp_path_factory.mktemp("a lab")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
        patch.chdir(path)
        return run_trial(path, request.param)


def test_a_trial_is_valid_and_the_robots_have_the_requested_network(trial: Trial) -> None:
    row = trial.row
    assert (row["status"], row["topology"], row["file_loss"]) == ("valid", "master", "0")
    state = (trial.files / "sender-before.txt").read_text(encoding="utf-8")
    links = gzip.decompress((trial.files / "sender-link.txt.gz").read_bytes()).decode()
    if trial.settings == "mesh":
        assert "type mesh point" in state
    else:
        assert "SSID: fieldkit" in links
        assert ("MFP:\t\tyes" in links) == (trial.settings == "wpa3")


def test_link_columns_are_those_of_iw(trial: Trial) -> None:
    for role in ("sender", "receiver"):
        assert -90 < float(trial.row[f"{role}_signal_median_dbm"]) < -30
        assert 1e6 <= float(trial.row[f"{role}_tx_rate_bit_s"]) <= 72.2e6
        assert int(trial.row[f"{role}_radio_tx_packets"]) >= 10
        assert int(trial.row[f"{role}_tx_retries"]) >= 0


def test_times_of_an_emulated_processor_are_withheld_and_the_row_has_the_reason(trial: Trial) -> None:
    assert trial.row["backend"] == "emulated (wifi linux, clock instructions)"
    time_columns = [name for name in trial.row if name.endswith(("_s", "_ppm")) and not name.endswith("_rate_bit_s")]
    assert {"rtt_median_s", "goodput_bit_s", "one_way_median_s", "sender_laptop_offset_s"} <= set(time_columns)
    assert [name for name in time_columns if trial.row[name]] == []


def test_columns_of_monitor_interfaces_agree_with_the_other_sources(trial: Trial) -> None:
    """A contradiction would have emptied the columns."""
    if trial.settings not in WITH_MONITOR:
        assert "sender_monitor_sent" not in trial.row
        return
    for role, sent_role in (("sender", "receiver"), ("receiver", "sender")):
        value = {name.removeprefix(f"{role}_monitor_"): text for name, text in trial.row.items() if role in name}
        assert int(value["sent"]) >= 10
        assert int(value["received"]) >= 10
        assert float(value["signal_dbm"]) == pytest.approx(float(trial.row[f"{role}_signal_median_dbm"]), abs=6.0)
        assert 6e6 <= float(value["tx_phy_rate_bit_s"]) <= 72.3e6
        assert 6e6 <= float(value["rx_phy_rate_bit_s"]) <= 72.3e6
        assert int(value["retries"]) <= int(trial.row[f"{role}_tx_retries"])
        frames = radiotap.read(trial.files / f"{role}-monitor.pcap").frames
        assert frames.is_sent.any()
        assert not frames.is_sent.all()
        packets = pcap.read(trial.files / f"{role}-monitor.pcap").packets
        is_encrypted = trial.settings != "mesh"
        assert (len(packets) == 0) == is_encrypted
        assert bool(np.any(frames.flags & 0x40)) == is_encrypted
        assert re.fullmatch(r"\d+", trial.row[f"{sent_role}_monitor_retry_flags"])
