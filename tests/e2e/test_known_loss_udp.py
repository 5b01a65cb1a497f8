"""Complete trials over UDP and a radio with a known loss: the measured loss must be the configured loss."""

import math
from collections.abc import Sequence
from statistics import median

import pytest
import scipy

from tests.helpers.known_radio import EACH_LOSS, REPEATS, LossyTables, Table, make_lab, run_all
from tests.helpers.runs import total

pytestmark = pytest.mark.emulated

FIVE_SIGMA = 0.9999994
"""The confidence level of five standard deviations. The captured packets and the radio's random draws for them differ
between runs. With four standard deviations, one run of this module in 400 failed."""
FRAGMENTS = 6  # of a datagram of 8,192 bytes in packets of 1,500


@pytest.fixture(scope="module", params=REPEATS)
def lossy_udp(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("udp")

    # 200 messages per second result in a bag of about 80 kB, which is 60 packets per repeat.
    def measure(losses: Sequence[int]) -> dict[str, Table]:
        labs = [make_lab(base / str(loss), f"{{loss: {loss}%, rate: 50Mbit/s}}", topic="/imu") for loss in losses]
        tables = run_all(labs, "--protocol", "udp", "--repeats", str(request.param))
        assert {name: len(table) for name, table in tables.items()} == {lab.name: request.param for lab in labs}
        return tables

    return LossyTables(measure)


@pytest.mark.parametrize("percent", EACH_LOSS)
def test_udp_ip_loss_is_the_loss_of_the_link(lossy_udp: dict[str, list[dict[str, str]]], percent: int) -> None:
    table = lossy_udp[str(percent)]
    sent, received = total(table, "ip_packets_sent"), total(table, "ip_packets_received")
    assert sent > len(table) * 20
    interval = scipy.stats.binomtest(sent - received, sent).proportion_ci(
        confidence_level=FIVE_SIGMA, method="wilson"
    )
    assert interval.low <= percent / 100 <= interval.high, (sent, received)


@pytest.mark.parametrize("percent", EACH_LOSS)
def test_runs_of_independent_losses_have_the_lengths_of_the_closed_form(
    lossy_udp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    """Starts of runs cannot be adjacent, which determines the variance of their number. The lengths are geometric."""
    table, loss = lossy_udp[str(percent)], percent / 100
    sent, bursts = total(table, "ip_packets_sent"), total(table, "ip_loss_bursts")
    start = loss * (1 - loss)
    expected = sent * start + len(table) * loss**2
    assert abs(bursts - expected) <= 5 * math.sqrt(sent * start * (1 - 3 * start)), (bursts, expected)
    longest = max(int(row["ip_loss_longest_burst"]) for row in table)
    assert (longest > 0) == (bursts > 0)
    if bursts:
        mean = (sent - total(table, "ip_packets_received")) / bursts
        assert abs(mean - 1 / (1 - loss)) <= 6 * math.sqrt(loss / bursts) / (1 - loss), mean
        # The probability that a run of k or more starts at one of `sent` positions is at most sent * (1 - loss) *
        # loss**k.
        assert longest < math.log(1e6 * sent * (1 - loss), 1 / loss)


def test_the_radio_neither_reorders_nor_duplicates_packets(lossy_udp: dict[str, list[dict[str, str]]]) -> None:
    for table in lossy_udp.values():
        for name in ("ip_packets_reordered", "ip_packets_duplicated", "ip_packets_doubtful"):
            assert total(table, name) == 0, name


@pytest.mark.parametrize("percent", EACH_LOSS)
def test_datagram_loss_is_the_loss_of_at_least_one_of_six_fragments(
    lossy_udp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    table = lossy_udp[str(percent)]
    loss, repeats = percent / 100, len(table)
    sent, received = total(table, "datagrams_sent"), total(table, "datagrams_received")
    # The last datagram of every repeat has the remainder of the file and a different number of fragments.
    fragments_of_last = total(table, "ip_packets_sent") - FRAGMENTS * (sent - repeats)
    delivered = (sent - repeats) * (1 - loss) ** FRAGMENTS + repeats * (1 - loss) ** (fragments_of_last / repeats)
    interval = scipy.stats.binomtest(sent - received, sent).proportion_ci(
        confidence_level=FIVE_SIGMA, method="wilson"
    )
    assert interval.low <= 1 - delivered / sent <= interval.high, (sent, received)
    if percent >= 10:
        packet_loss = 1 - total(table, "ip_packets_received") / total(table, "ip_packets_sent")
        assert (sent - received) / sent > 2 * packet_loss


@pytest.mark.parametrize("percent", EACH_LOSS)
def test_the_air_delay_is_measured_for_the_packets_that_arrived(
    lossy_udp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    table = lossy_udp[str(percent)]
    # Occasionally ROS retransmits a packet during the transfer.
    missing = [int(row["delay_packets"]) - int(row["ip_packets_received"]) for row in table]
    assert min(missing) >= 0
    assert missing.count(0) > len(table) // 2


def test_the_parts_of_the_delay_are_those_of_a_link_of_50_mbit_s(lossy_udp: dict[str, list[dict[str, str]]]) -> None:
    undisturbed_rows = [row for row in lossy_udp["0"] if row["delay_packets"] == row["ip_packets_received"]]
    assert undisturbed_rows
    for row in undisturbed_rows:
        # Each packet has an IP header of 20 bytes, and each datagram has a UDP header of 8 bytes.
        packets = int(row["ip_packets_received"])
        size_bytes = int(row["sent_bytes"]) + 8 * int(row["datagrams_sent"]) + 20 * packets
        assert float(row["delay_transmission_s"]) == pytest.approx(8 * size_bytes / 50e6 / packets, rel=1e-6)
    queuing_s, transmission_s = (
        median(float(row[f"delay_{part}_s"]) for row in undisturbed_rows) for part in ("queuing", "transmission")
    )
    assert queuing_s > transmission_s, "the six fragments of a datagram arrive together"


@pytest.mark.parametrize("percent", EACH_LOSS)
def test_the_papers_loss_counts_first_fragments_only(
    lossy_udp: dict[str, list[dict[str, str]]], percent: int
) -> None:
    table = lossy_udp[str(percent)]
    for row in table:
        assert row["paper_packets"] == row["datagrams_sent"]
        assert int(row["paper_received"]) >= int(row["datagrams_received"])
        assert float(row["paper_loss"]) == pytest.approx(1 - int(row["paper_received"]) / int(row["paper_packets"]))
    sent, received = total(table, "paper_packets"), total(table, "paper_received")
    interval = scipy.stats.binomtest(sent - received, sent).proportion_ci(
        confidence_level=FIVE_SIGMA, method="wilson"
    )
    assert interval.low <= percent / 100 <= interval.high
