"""A radio with known loss, measured by whole trials over UDP: what comes out must be what was put in."""

import pytest
from scipy.stats import binomtest

from tests.known_radio import LOSSES_PERCENT, REPEATS, make_lab, run_all
from tests.runs import total

pytestmark = pytest.mark.emulated

FRAGMENTS = 6  # of a datagram of 8,192 bytes in packets of 1,500


@pytest.fixture(scope="module")
def lossy_udp(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("udp")
    # 200 messages a second make a bag of some 80 kB: 60 packets a repeat.
    labs = [make_lab(base / str(loss), f"{{loss: {loss}%, rate: 50Mbit/s}}", topic="/imu") for loss in LOSSES_PERCENT]
    return run_all(labs, "--protocol", "udp", "--repeats", str(REPEATS))


@pytest.mark.parametrize("percent", LOSSES_PERCENT)
def test_udp_ip_loss_is_the_loss_of_the_link(lossy_udp: dict[str, list[dict[str, str]]], percent: int) -> None:
    table = lossy_udp[str(percent)]
    assert len(table) == REPEATS
    sent, received = total(table, "ip_packets_sent"), total(table, "ip_packets_received")
    assert sent > REPEATS * 40
    interval = binomtest(sent - received, sent).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= percent / 100 <= interval.high, (sent, received)


@pytest.mark.parametrize("percent", LOSSES_PERCENT)
def test_datagram_loss_is_larger_as_six_fragments_predict(
    lossy_udp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    table = lossy_udp[str(percent)]
    loss = percent / 100
    sent, received = total(table, "datagrams_sent"), total(table, "datagrams_received")
    # Every repeat's last datagram is the rest of the file; it has fragments of its own number.
    fragments_of_last = total(table, "ip_packets_sent") - FRAGMENTS * (sent - REPEATS)
    delivered = (sent - REPEATS) * (1 - loss) ** FRAGMENTS + REPEATS * (1 - loss) ** (fragments_of_last / REPEATS)
    interval = binomtest(sent - received, sent).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 1 - delivered / sent <= interval.high, (sent, received)
    if percent >= 10:
        packet_loss = 1 - total(table, "ip_packets_received") / total(table, "ip_packets_sent")
        assert (sent - received) / sent > 2 * packet_loss


@pytest.mark.parametrize("percent", LOSSES_PERCENT)
def test_the_papers_loss_sees_first_fragments_only(lossy_udp: dict[str, list[dict[str, str]]], percent: int) -> None:
    table = lossy_udp[str(percent)]
    for row in table:
        assert row["paper_packets"] == row["datagrams_sent"]
        assert int(row["paper_received"]) >= int(row["datagrams_received"])
        assert float(row["paper_loss"]) == pytest.approx(1 - int(row["paper_received"]) / int(row["paper_packets"]))
    sent, received = total(table, "paper_packets"), total(table, "paper_received")
    interval = binomtest(sent - received, sent).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= percent / 100 <= interval.high
