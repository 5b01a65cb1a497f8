"""Telemetry sources of a profile in a trial: the row and table have values and sources, and notes report failures."""

import gzip
import re
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT
from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import site

pytestmark = pytest.mark.emulated

TELEMETRY = """
telemetry:
  sources:
    lte:
      command: [echo, '{"rsrp": -97.5, "sinr": "12.5 dB", "band": "B3", "rate": 43.2}']
      interval: 1s
      values:
        signal_dbm: {json: rsrp}
        sinr_db: {json: sinr}
        band: {json: band}
        tx_rate_bit_s: {json: rate, factor: 1000000}
    stuck:
      command: [sh, -c, "trap '' TERM; sleep 1000"]
      limit: 1s
      values: {noise_dbm: {json: noise}}
    near:
      at: laptop
      command: [echo, "stations=3 cell=02:00:00:00:00:07"]
      values:
        neighbours: {regex: "stations=([0-9]+)"}
        cell: {regex: "cell=([0-9a-f:]+)"}
    loop:
      http: {url: "http://127.0.0.1:9/signal"}
      values: {rx_rate_bit_s: {json: rate}}
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    profile = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    (tmp_path / "robots").mkdir()
    text = profile.replace("name: turtlebot3_burger", "name: modem_bot") + TELEMETRY
    (tmp_path / "robots" / "modem_bot.yaml").write_text(text, encoding="utf-8")
    robots = {"rover-1": "modem_bot", "rover-2": "turtlebot3_burger"}
    (tmp_path / "fieldkit.yaml").write_text(site(robots, emulated="ros: builtin"), encoding="utf-8")
    return tmp_path


def test_row_and_table_show_values_and_sources(lab: Path) -> None:
    words = ("los", "10ft", "--topology", "masterless", "--protocol", "tcp", "--repeats", "1", "--record", "2s")
    run = run_here(lab, "trial", *words)
    assert run.code == 0, run.err + run.out
    assert "tcp-01: telemetry stuck of the sender gave no value: no answer in 1 s" in run.err + run.out
    assert "tcp-01: telemetry loop of the sender gave no value: connection refused" in run.err + run.out
    trial = only_trial(lab)
    (row,) = rows(trial)
    assert row["status"] == "valid"
    assert row["sender_link_source"] == (
        "lte (command): signal_dbm sinr_db band tx_rate_bit_s; near (command): cell neighbours; others: testbed"
    )
    expected = {
        "signal_median_dbm": "-97.5",
        "signal_last_dbm": "-97.5",
        "sinr_median_db": "12.5",
        "band": "B3",
        "tx_rate_bit_s": "43200000",
        "neighbours_min": "3",
        "cell": "02:00:00:00:00:07",
        "roams": "0",
        "noise_dbm": "",
        "rx_rate_bit_s": "",
    }
    assert {name: row[f"sender_{name}"] for name in expected} == expected
    assert int(row["sender_radio_tx_packets"]) > 0, "no source has this value, so it is from the testbed"
    assert float(row["receiver_signal_median_dbm"]) > -60, "the other robot has no sources"
    assert re.search(r"signal, sender, median +-97\.50 dBm", run.out)
    assert re.search(r"link source, sender +'lte \(command\)", run.out)
    folder = trial / "repeats" / "tcp-01"
    with gzip.open(folder / "sender-telemetry-lte.txt.gz", "rb") as file:
        assert file.read().count(b" 0 ") >= 2
    assert (folder / "sender-telemetry-near-laptop.txt").read_bytes().startswith(b"==> ")
    before = (trial / "trial.csv").read_bytes()
    assert run_here(lab, "rebuild", str(trial)).code == 0
    assert (trial / "trial.csv").read_bytes() == before
