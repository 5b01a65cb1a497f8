"""A radio with known loss, measured by whole trials over TCP: every byte arrives, and what was repaired counts."""

import pytest

from tests.known_radio import LOSSES_PERCENT, REPEATS, make_lab, run_all
from tests.runs import total

pytestmark = pytest.mark.emulated


@pytest.fixture(scope="module")
def lossy_tcp(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("tcp")
    # With 30 % lost in each direction a segment's timer doubles again and again: a small bag bounds the waiting.
    topics = dict.fromkeys(LOSSES_PERCENT, "/imu") | {30: "/battery_state"}
    radios = {loss: f"{{loss: {loss}%, rate: 50Mbit/s}}" for loss in LOSSES_PERCENT}
    labs = [make_lab(base / str(loss), radio, topic=topics[loss]) for loss, radio in radios.items()]
    return run_all(labs, "--protocol", "tcp", "--repeats", str(REPEATS))


@pytest.mark.parametrize("percent", LOSSES_PERCENT)
def test_tcp_delivers_every_byte_and_counts_what_it_repaired(
    lossy_tcp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    table = lossy_tcp[str(percent)]
    assert len(table) == REPEATS
    for row in table:
        assert row["hash_match"] == "true"
        assert row["tcp_unique_bytes"] == row["sent_bytes"] == row["received_bytes"]
        assert float(row["file_loss"]) == 0
    retransmitted = total(table, "tcp_retransmitted_segments")
    assert (retransmitted == 0) if percent == 0 else (retransmitted > 0)
    if percent >= 10:
        assert sum(float(row["tcp_byte_loss"]) for row in table) > 0
