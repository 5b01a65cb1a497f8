"""Link statistics of radio drivers, compared with captures, the kernel's counters and the air log."""

import csv
import re
from pathlib import Path

import pytest

from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import site

pytestmark = pytest.mark.emulated

# Without fading, the SNR is always 23.1 dB, which is too low for n7: half of the frames of 1,500 bytes are lost, and
# a
# fifth of the frames of 500 bytes. Repeats of 11 and 20 frames need no retry with a probability of at most 1e-4.
SITE = site(emulated="ros: builtin, record_air: true, radio: {mode: n7, fading: false, noise_floor_dbm: -84.2}")


def kernel_packets(folder: Path, role: str) -> dict[str, int]:
    """Return the kernel's packet counts of the interface during the repeat."""
    counts_at_moments = []
    for moment in ("before", "after"):
        text = (folder / f"{role}-{moment}.txt").read_text(encoding="utf-8")
        fields = re.search(r"^ *wlan0: *(.+)$", text, re.MULTILINE)
        assert fields
        counts = fields[1].split()
        counts_at_moments.append({"rx": int(counts[1]), "tx": int(counts[9])})
    return {
        direction: counts_at_moments[1][direction] - counts_at_moments[0][direction] for direction in ("rx", "tx")
    }


def test_radios_kernels_captures_and_the_air_log_have_equal_counts(tmp_path: Path) -> None:
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    run = run_here(tmp_path, "trial", "los", "60ft", "--topology", "masterless", "--repeats", "1", "--record", "1s")
    assert run.code == 0, run.err + run.out
    trial = only_trial(tmp_path)
    for row in rows(trial):
        if row["status"] != "valid":
            continue
        folder = trial / "repeats" / f"{row['protocol']}-01"
        with (folder / "air.csv").open(encoding="ascii", newline="") as file:
            air = [line for line in csv.DictReader(file) if line["attempt"] != "0"]
        assert air
        for role, other in (("sender", "receiver"), ("receiver", "sender")):
            kernel, from_robot = (
                kernel_packets(folder, role),
                [line for line in air if line["transmitter"] == row[role]],
            )
            driver_counts = {
                name: int(row[f"{role}_{name}"]) for name in ("radio_tx_packets", "radio_rx_packets", "tx_retries")
            }
            assert kernel == {"tx": driver_counts["radio_tx_packets"], "rx": driver_counts["radio_rx_packets"]}
            assert driver_counts["radio_tx_packets"] + driver_counts["radio_rx_packets"] == int(
                row[f"{role}_captured"]
            )
            assert driver_counts["radio_tx_packets"] == sum(line["attempt"] == "1" for line in from_robot)
            assert driver_counts["tx_retries"] == sum(line["attempt"] != "1" for line in from_robot)
            assert driver_counts["radio_tx_packets"] - int(row[f"{other}_radio_rx_packets"]) >= 0
            assert float(row[f"{role}_signal_min_dbm"]) <= float(row[f"{role}_signal_median_dbm"]) < -40
            assert float(row[f"{role}_tx_rate_bit_s"]) == 65e6
            assert 0 < float(row[f"{role}_busy_share"]) < 1
            assert row[f"{role}_roams"] == row[f"{role}_beacon_losses"] == "", (
                "the emulated radio has no roaming and no beacons"
            )
        assert sum(int(row[f"{role}_tx_retries"]) for role in ("sender", "receiver")) > 0, "the test needs retries"
