"""`fieldkit trial los 30ft` with Linux's Wi-Fi in the virtual machine, as a user runs it; results are on the host."""

import csv
import gzip
from pathlib import Path

import pytest

from fieldkit.cli import main
from sim_backends.emulated.linux_wifi.virtual_machine import ROOT_VARIABLE
from tests.helpers.paths import ROOT

pytestmark = [pytest.mark.emulated, pytest.mark.nightly]

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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a lab in which one repeat has run, with a name that needs quoting."""
    path = tmp_path_factory.mktemp("a lab")
    (path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ROOT_VARIABLE, str(ROOT / ".linux"))
        patch.chdir(path)
        assert main(["trial", "los", "30ft", "--protocol", "udp", "--repeats", "1", "--record", "1s"]) == 0
    return path


@pytest.fixture(scope="module")
def row(folder: Path) -> dict[str, str]:
    """The row of the only repeat."""
    (table,) = folder.glob("trials/*/trial.csv")
    (only_row,) = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    return only_row


def test_a_trial_over_the_access_point_of_the_relay_is_valid(row: dict[str, str], folder: Path) -> None:
    assert (row["status"], row["topology"], row["file_loss"]) == ("valid", "master", "0")
    (links,) = folder.glob("trials/*/repeats/udp-01/sender-link.txt.gz")
    assert "SSID: fieldkit" in gzip.decompress(links.read_bytes()).decode()


def test_link_columns_are_those_of_iw(row: dict[str, str]) -> None:
    for role in ("sender", "receiver"):
        assert -90 < float(row[f"{role}_signal_median_dbm"]) < -30
        assert 1e6 <= float(row[f"{role}_tx_rate_bit_s"]) <= 72.2e6
        assert int(row[f"{role}_radio_tx_packets"]) >= 10
        assert int(row[f"{role}_tx_retries"]) >= 0


def test_times_of_an_emulated_processor_are_withheld_and_the_row_has_the_reason(row: dict[str, str]) -> None:
    assert row["backend"] == "emulated (wifi linux, clock instructions)"
    time_columns = [name for name in row if name.endswith(("_s", "_ppm")) and not name.endswith("_rate_bit_s")]
    assert {"rtt_median_s", "transfer_s", "goodput_bit_s", "one_way_median_s"} <= set(time_columns)
    assert [name for name in time_columns if row[name]] == []
