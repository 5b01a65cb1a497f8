"""A radio with known loss, measured by whole trials over TCP: every byte arrives, and what was repaired counts."""

import pytest

from tests.helpers.known_radio import LOSSES_PERCENT, REPEATS, make_lab, run_all
from tests.helpers.runs import total

pytestmark = pytest.mark.emulated

# With 30 % lost in each direction every other round trip fails and TCP doubles its timer each time: one transfer in
# ten waits for a minute or more, so 20 took up to 450 s. What is asserted of each, and of their sum, needs fewer.
SHARE_AT = dict.fromkeys(LOSSES_PERCENT, 1.0) | {30: 0.4}


@pytest.fixture(scope="module", params=REPEATS)
def lossy_tcp(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("tcp")
    # At 30 % a small bag, too, bounds the waiting.
    topics = dict.fromkeys(LOSSES_PERCENT, "/imu") | {30: "/battery_state"}
    radios = {loss: f"{{loss: {loss}%, rate: 50Mbit/s}}" for loss in LOSSES_PERCENT}
    repeats = {loss: int(share * request.param) for loss, share in SHARE_AT.items()}
    labs = [
        make_lab(base / str(loss), radio, topic=topics[loss], repeats=repeats[loss]) for loss, radio in radios.items()
    ]
    tables = run_all(labs, "--protocol", "tcp")
    assert {name: len(table) for name, table in tables.items()} == {str(loss): of for loss, of in repeats.items()}
    return tables


@pytest.mark.parametrize("percent", LOSSES_PERCENT)
def test_tcp_delivers_every_byte_and_counts_what_it_repaired(
    lossy_tcp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    table = lossy_tcp[str(percent)]
    for row in table:
        assert row["hash_match"] == "true"
        assert row["tcp_unique_bytes"] == row["sent_bytes"] == row["received_bytes"]
        assert float(row["file_loss"]) == 0
    if percent > 0:
        assert total(table, "tcp_retransmitted_segments") > 0
    if percent >= 10:
        assert sum(float(row["tcp_byte_loss"]) for row in table) > 0


@pytest.mark.parametrize("percent", LOSSES_PERCENT)
def test_what_the_receiver_saw_twice_is_what_tcp_sent_twice(
    lossy_tcp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    """The radio is a queue that copies nothing, and TUN devices let no super-frame pass."""
    for row in lossy_tcp[str(percent)]:
        number = {name: int(value) for name, value in row.items() if name.startswith("tcp_") and value.isdigit()}
        assert number["tcp_received_bytes"] == number["tcp_unique_bytes"] + number["tcp_duplicated_bytes"]
        assert number["tcp_spurious_segments"] <= number["tcp_retransmitted_segments"]
        for name in ("tcp_reordered_segments", "tcp_doubtful_segments", "tcp_superframes"):
            assert number[name] == 0, name


def test_tcp_repeats_mostly_what_was_lost(lossy_tcp: dict[str, list[dict[str, str]]]) -> None:
    """Needless is what follows a lost acknowledgment that no later one makes good, or a pause of this machine."""
    without_loss = lossy_tcp["0"]
    for row in without_loss:
        assert row["tcp_retransmitted_segments"] == row["tcp_spurious_segments"], "nothing was lost"
    paused = sum(row["tcp_retransmitted_segments"] != "0" for row in without_loss)
    assert paused <= len(without_loss) / 2, "a machine may be busy, but not in every repeat"
    spurious, retransmitted = (
        sum(total(table, f"tcp_{what}_segments") for table in lossy_tcp.values())
        for what in ("spurious", "retransmitted")
    )
    assert spurious <= retransmitted / 2, (spurious, retransmitted)
