"""A radio with known loss and delay, measured by whole trials: what comes out must be what was put in."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median

import pytest
from scipy.stats import binomtest

from tests.runs import Run, fieldkit, only_trial, rows, total

pytestmark = pytest.mark.emulated

LOSSES_PERCENT = (0, 1, 10, 30)
REPEATS = 20
FRAGMENTS = 6  # of a datagram of 8,192 bytes in packets of 1,500

SITE = """\
backend: emulated
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  turtlebot-2: {profile: turtlebot3_burger}
roles:
  masterless: {sender: turtlebot-1, receiver: turtlebot-2}
emulated:
  ros: builtin
  radio: RADIO
"""

# The paper's steps, quicker: a bag of about 15 kB per half second, few pings.
PROCEDURE = """\
name: quick
summary: the paper's steps, quicker
scenario: los
topology: masterless
protocols: [tcp, udp]
repeats: 20
attempts: 1
steps:
  - record: {robot: sender, topics: [TOPIC], duration: 1s, name: scan}
  - capture:
      robots: [sender, receiver]
      during:
        - transfer: {from: sender, to: receiver, idle: 1s, limit: 600s}
  - ping: {from: sender, to: receiver, count: PINGS, interval: 20ms}
"""


def make_lab(lab: Path, radio: str, *, topic: str = "/scan", pings: int = 1) -> Path:
    lab.mkdir()
    (lab / "fieldkit.yaml").write_text(SITE.replace("RADIO", radio), encoding="utf-8")
    (lab / "procedures").mkdir()
    text = PROCEDURE.replace("TOPIC", topic).replace("PINGS", str(pings))
    (lab / "procedures" / "quick.yaml").write_text(text, encoding="utf-8")
    return lab


def measured(runs: dict[Path, Run]) -> dict[str, list[dict[str, str]]]:
    for run in runs.values():
        assert run.code == 0, run.err + run.out
    return {lab.name: rows(only_trial(lab)) for lab in runs}


def run_all(labs: list[Path], *words: str) -> dict[str, list[dict[str, str]]]:
    """Run the same trial in every lab at once: they share nothing but this machine."""
    with ThreadPoolExecutor(len(labs)) as pool:
        runs = list(pool.map(lambda lab: fieldkit(lab, "trial", "quick", "5m", *words), labs))
    return measured(dict(zip(labs, runs, strict=True)))


@pytest.fixture(scope="module")
def lossy_udp(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("udp")
    # 200 messages a second make a bag of some 80 kB: 60 packets a repeat.
    labs = [make_lab(base / str(loss), f"{{loss: {loss}%, rate: 50Mbit/s}}", topic="/imu") for loss in LOSSES_PERCENT]
    return run_all(labs, "--protocol", "udp", "--repeats", str(REPEATS))


@pytest.fixture(scope="module")
def lossy_tcp(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, str]]]:
    base = tmp_path_factory.mktemp("tcp")
    # With 30 % lost in each direction a segment's timer doubles again and again: a small bag bounds the waiting.
    topics = dict.fromkeys(LOSSES_PERCENT, "/imu") | {30: "/battery_state"}
    radios = {loss: f"{{loss: {loss}%, rate: 50Mbit/s}}" for loss in LOSSES_PERCENT}
    labs = [make_lab(base / str(loss), radio, topic=topics[loss]) for loss, radio in radios.items()]
    return run_all(labs, "--protocol", "tcp", "--repeats", str(REPEATS))


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
