"""A complete trial over a radio that delivers no packets."""

from pathlib import Path

import pytest

from tests.helpers.known_radio import make_lab, run_all

pytestmark = pytest.mark.emulated


def test_a_transfer_over_a_dead_link_is_stopped_at_its_limit_and_measured(tmp_path: Path) -> None:
    lab = make_lab(tmp_path / "dead", "{loss: 100%}")
    procedure = lab / "procedures" / "quick.yaml"
    procedure.write_text(procedure.read_text(encoding="utf-8").replace("limit: 600s", "limit: 10s"), encoding="utf-8")
    table = run_all([lab], "--repeats", "1")["dead"]
    assert [row["protocol"] for row in table] == ["tcp", "udp"]
    for row in table:
        assert (row["status"], row["received_bytes"], row["file_loss"], row["hash_match"]) == (
            "valid",
            "0",
            "1",
            "false",
        )
        assert row["one_way_withheld"] == "no packet of the transfer is in both captures"
        assert row["transfer_s"] == row["delay_s"] == "", "a missing value is empty"
        assert row["delay_packets"] == "0"
        assert row["rtt_loss"] == "1"
