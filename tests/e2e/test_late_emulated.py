"""A repeat in which the emulator was too late is not valid."""

from pathlib import Path

import pytest

from fieldkit.config.locations import SITE_FILE
from tests.helpers.known_radio import make_lab
from tests.helpers.labs import replace_text
from tests.helpers.runs import only_trial, rows, run_here

pytestmark = pytest.mark.emulated


def test_a_repeat_with_excessive_lateness_does_not_count(tmp_path: Path) -> None:
    lab = make_lab(tmp_path / "late", "{}")
    site = lab / SITE_FILE
    site.write_text(
        replace_text(site.read_text(encoding="utf-8"), "late_bound: 2s", "late_bound: 0.001ms"), encoding="utf-8"
    )
    procedure = lab / "procedures" / "quick.yaml"
    procedure.write_text(
        procedure.read_text(encoding="utf-8").replace("attempts: 3", "attempts: 1"), encoding="utf-8"
    )
    run = run_here(lab, "trial", "quick", "5m", "--repeats", "1", "--protocol", "udp")
    assert run.code == 4, run.err
    trial = only_trial(lab)
    (row,) = rows(trial)
    assert row["status"] == "failed"
    assert row["reason"].startswith("lateness.txt: ")
    assert row["reason"].endswith(" ms; the bound is 0.001 ms")
    assert int(row["emulator_too_late"]) >= int(row["ip_packets_received"])
    assert 1e-6 < float(row["emulator_late_p99_s"]) <= float(row["emulator_late_max_s"])
    table = (trial / "trial.csv").read_bytes()
    assert run_here(lab, "rebuild", str(trial)).code == 0
    assert (trial / "trial.csv").read_bytes() == table
