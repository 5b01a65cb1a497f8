"""Complete trials over TCP and a radio with a known loss: every byte arrives, and retransmissions are counted."""

from collections.abc import Sequence

import pytest

from tests.helpers.known_radio import EACH_LOSS, LOSSES_PERCENT, REPEATS, LossyTables, Table, make_lab, run_all
from tests.helpers.runs import total

pytestmark = pytest.mark.emulated

# With a loss of 30 % in each direction, every second round trip fails, and TCP doubles its timer each time. One
# transfer in ten takes a minute or more, so 20 transfers took up to 450 s. The assertions need fewer transfers.
SHARE_AT = dict.fromkeys(LOSSES_PERCENT, 1.0) | {30: 0.4}

SEGMENT_BYTES = 1448


@pytest.fixture(scope="module", params=REPEATS)
def lossy_tcp(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("tcp")
    # At 30 % a small bag also limits the duration.
    topics = dict.fromkeys(LOSSES_PERCENT, "/imu") | {30: "/battery_state"}
    repeats = {loss: int(share * request.param) for loss, share in SHARE_AT.items()}

    def measure(losses: Sequence[int]) -> dict[str, Table]:
        radios = {loss: f"{{loss: {loss}%, rate: 50Mbit/s}}" for loss in losses}
        labs = [
            make_lab(base / str(loss), radio, topic=topics[loss], repeats=repeats[loss])
            for loss, radio in radios.items()
        ]
        tables = run_all(labs, "--protocol", "tcp")
        assert {name: len(table) for name, table in tables.items()} == {str(loss): repeats[loss] for loss in losses}
        return tables

    return LossyTables(measure)


@pytest.mark.parametrize("percent", EACH_LOSS)
def test_tcp_delivers_every_byte_and_retransmissions_are_counted(
    lossy_tcp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    table = lossy_tcp[str(percent)]
    for row in table:
        assert row["hash_match"] == "true"
        assert row["tcp_unique_bytes"] == row["sent_bytes"] == row["received_bytes"]
        assert float(row["file_loss"]) == 0
    segments = total(table, "sent_bytes") / SEGMENT_BYTES
    if (1 - percent / 100) ** segments < 1e-6:  # otherwise, no packet may be lost
        assert total(table, "tcp_retransmitted_segments") > 0
        assert sum(float(row["tcp_byte_loss"]) for row in table) > 0


@pytest.mark.parametrize("percent", EACH_LOSS)
def test_packets_received_twice_are_those_that_tcp_sent_twice(
    lossy_tcp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    """The radio is a queue that duplicates no packets, and TUN devices do not aggregate packets."""
    for row in lossy_tcp[str(percent)]:
        counts = {name: int(value) for name, value in row.items() if name.startswith("tcp_") and value.isdigit()}
        assert counts["tcp_received_bytes"] == counts["tcp_unique_bytes"] + counts["tcp_duplicated_bytes"]
        assert counts["tcp_spurious_segments"] <= counts["tcp_retransmitted_segments"]
        for name in ("tcp_reordered_segments", "tcp_doubtful_segments", "tcp_superframes"):
            assert counts[name] == 0, name


def test_tcp_retransmits_mostly_lost_packets(lossy_tcp: dict[str, list[dict[str, str]]]) -> None:
    """Spurious retransmissions follow a lost acknowledgment that no later one replaces, or a pause of the machine."""
    without_loss = lossy_tcp["0"]
    for row in without_loss:
        assert row["tcp_retransmitted_segments"] == row["tcp_spurious_segments"], "no packet was lost"
    paused_repeats = sum(row["tcp_retransmitted_segments"] != "0" for row in without_loss)
    assert paused_repeats <= len(without_loss) / 2, "a machine may be busy, but not in every repeat"
    spurious, retransmitted = (
        sum(total(table, f"tcp_{kind}_segments") for table in lossy_tcp.values())
        for kind in ("spurious", "retransmitted")
    )
    assert spurious <= retransmitted / 2, (spurious, retransmitted)
