"""A radio with known delay, and one that is dead, measured by whole trials."""

from pathlib import Path
from statistics import median

import pytest

from tests.known_radio import make_lab, run_all

pytestmark = pytest.mark.emulated


@pytest.fixture(scope="module")
def delayed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("delay")
    measured_one_by_one: dict[str, list[dict[str, str]]] = {}
    for delay_ms in (5, 20):
        lab = make_lab(base / str(delay_ms), f"{{loss: 0%, delay: {delay_ms}ms, rate: unlimited}}", pings=50)
        measured_one_by_one |= run_all([lab], "--repeats", "2")
    return measured_one_by_one


@pytest.mark.parametrize("delay_ms", [5, 20])
def test_median_rtt_is_twice_the_delay_of_the_link(delayed: dict[str, list[dict[str, str]]], delay_ms: int) -> None:
    table = delayed[str(delay_ms)]
    assert [row["rtt_payload_bytes"] for row in table] == ["502", "8192", "502", "8192"]
    medians_ms = [1e3 * float(row["rtt_median_s"]) for row in table]
    assert median(medians_ms) == pytest.approx(2 * delay_ms, abs=0.5)
    assert all(rtt_ms >= 2 * delay_ms for rtt_ms in medians_ms)


def test_a_transfer_over_a_dead_link_is_ended_at_its_limit_and_measured_as_it_is(tmp_path: Path) -> None:
    lab = make_lab(tmp_path / "dead", "{loss: 100%}")
    procedure = lab / "procedures" / "quick.yaml"
    procedure.write_text(procedure.read_text(encoding="utf-8").replace("limit: 600s", "limit: 3s"), encoding="utf-8")
    for row in run_all([lab], "--repeats", "1")["dead"]:
        assert (row["status"], row["received_bytes"], row["file_loss"], row["hash_match"]) == (
            "valid",
            "0",
            "1",
            "false",
        )
        assert row["transfer_s"] == "", "missing is empty"
        assert row["rtt_loss"] == "1"
