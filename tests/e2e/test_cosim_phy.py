"""`fieldkit cosim run` with radios of 802.11n, ac and ax, in a fast stream, and errors of impossible radios."""

import csv
import io
from pathlib import Path

import pytest

from tests.helpers.runs import Run, run_here

SCENARIO = """\
name: wide
summary: one robot sends more than 802.11g carries
world: baylands
duration: 1s
policy: {name: sliding_window, window: 10ms}
agents:
  ann: {robot: husky, along: 0m, radio: RADIO}
  bob: {robot: husky, along: 10m, radio: RADIO}
traffic:
  - {kind: stream, name: video, from: ann, to: bob, rate: 8kHz, size_bytes: 1000}
"""


def run(lab: Path, radio: str) -> Run:
    (lab / "wide.yaml").write_text(SCENARIO.replace("RADIO", radio), encoding="utf-8")
    return run_here(lab, "cosim", "run", "wide.yaml", "--format", "csv")


def loss(completed_run: Run) -> float:
    assert completed_run.code == 0, completed_run.err
    (row,) = csv.DictReader(io.StringIO(completed_run.out))
    return float(row["loss"])


def test_a_wide_radio_with_aggregation_carries_a_stream_that_80211g_cannot(tmp_path: Path) -> None:
    """The stream needs 64 Mbit/s."""
    wide = "{standard: 802.11ax 5 GHz, phy: {width_mhz: 80, streams: 2}}"
    assert loss(run(tmp_path, wide)) < 0.01
    assert loss(run(tmp_path, "{standard: 802.11g}")) > 0.5


@pytest.mark.parametrize(
    ("radio", "message"),
    [
        ("{standard: 802.11n 2.4 GHz, phy: {width_mhz: 160}}", "a width of 160 MHz is not modelled"),
        ("{standard: 802.11n 2.4 GHz, phy: {guard_interval_ns: 3200}}", "802.11n has no guard interval of 3200 ns"),
        ("{standard: 802.11ax 5 GHz}", "without phy there is no standard '802.11ax 5 GHz'"),
    ],
)
def test_an_impossible_radio_is_rejected_with_its_reason(tmp_path: Path, radio: str, message: str) -> None:
    completed_run = run(tmp_path, radio)
    assert completed_run.code != 0
    assert message in " ".join(completed_run.err.split())
