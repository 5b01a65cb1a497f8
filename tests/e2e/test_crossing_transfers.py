"""Simultaneous transfers and pings on emulated robots; each is measured as if it ran alone."""

from collections import Counter
from collections.abc import Iterator, Mapping
from ipaddress import IPv4Address
from pathlib import Path

import pytest

from fieldkit.core.columns import Value
from fieldkit.core.model import Protocol, RepeatId, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.headers import TCP, UDP
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.trial import gates, planned_evidence
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans
from tests.helpers.dissected import Row, dissected
from tests.helpers.labs import write_procedure
from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import TURTLEBOTS_AND_DRONE, procedure, site

pytestmark = pytest.mark.emulated

SITE = site(TURTLEBOTS_AND_DRONE, emulated="ros: builtin, radio: {loss: 5%, rate: 50Mbit/s}")
PROCEDURE = procedure(
    "cross",
    """\
- together:
    during:
      - record: {robot: sender, topics: [/imu], duration: 1s}
      - record: {robot: receiver, topics: [/imu], duration: 1s, name: theirs}
      - record: {robot: relay, topics: [/pidrone/imu], duration: 1s, name: third}
- capture:
    robots: [sender, receiver, relay]
    during:
      - together:
          during:
            - transfer: {name: up, from: sender, to: receiver, idle: 1s, port: 1001}
            - transfer: {name: down, from: receiver, to: sender, idle: 1s, port: 1002, file: theirs}
            - transfer: {name: rival, from: relay, to: receiver, idle: 1s, port: 1003, file: third}
            - ping: {name: load, from: sender, to: receiver, count: 20, interval: 50ms, payload_bytes: 4000}
      - ping: {from: sender, to: receiver, count: 10, interval: 20ms, payload_bytes: 100}
""",
    topology="master",
    protocols="tcp, udp",
    repeats=2,
    attempts=4,
)

Values = Mapping[str, Value]


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lab = tmp_path_factory.mktemp("cross")
    (lab / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    run = run_here(lab, "trial", write_procedure(lab, PROCEDURE), "5m", "--seed", "4")
    assert run.code == 0, run.err + run.out
    assert "up: " in run.out
    return only_trial(lab)


def attempts(trial: Path, protocol: Protocol) -> list[tuple[Plan, Path, Values]]:
    """Return the plan, folder and measured values of each valid attempt."""
    plan, results = plans.read_plan(trial), []
    for row in rows(trial):
        if row["protocol"] != protocol or row["status"] != "valid":
            continue
        repeat = RepeatId(protocol, int(row["repeat"]))
        folder = trial / "repeats" / str(repeat)
        verdict = gates.judge(plan, repeat, AttemptEvidence(folder))
        assert not verdict.problems
        results.append((plan, folder, verdict.measured.values))
    assert len(results) == 2
    return results


def packet_keys(capture: list[Row], transfer: Transfer, protocol: int) -> Iterator[tuple[bool, Row]]:
    """Yield two values per packet between the ends of a transfer.

    They are True if the packet has the port of the transfer, and the packet's id and fragment position.
    """
    ends = tuple(
        0xFFFF << 32 | int(IPv4Address(address)) for address in (transfer.sender_address, transfer.receiver_address)
    )
    for row in capture:
        if row[2:5] == (*ends, protocol):
            yield row[11] == transfer.port, (row[5], row[6], row[9])


def test_the_losses_of_each_udp_transfer_equal_those_counted_by_scapy(trial: Path) -> None:
    """Scapy identifies a transfer's datagrams by port, and their other fragments by the id of the first."""
    lost_packets = 0
    for plan, folder, values in attempts(trial, Protocol.UDP):
        captures = {role: dissected(folder / f"{role}.pcap") for role in (Role.SENDER, Role.RECEIVER, Role.RELAY)}
        for transfer in planned_evidence.transfers(plan, Protocol.UDP):
            sent_keys = list(packet_keys(captures[transfer.source], transfer, UDP))
            ids = {key[0] for is_first, key in sent_keys if is_first}
            sent_packets = Counter(key for _, key in sent_keys if key[0] in ids)
            received_packets = Counter(key for _, key in packet_keys(captures[transfer.destination], transfer, UDP))
            arrived_packets = sum((sent_packets & received_packets).values())
            name = transfer.name
            assert values[f"{name}.ip_packets_sent"] == sent_packets.total()
            assert values[f"{name}.ip_packets_received"] == arrived_packets == values[f"{name}.delay_packets"]
            assert values[f"{name}.datagrams_sent"] == len(ids) == values[f"{name}.paper_packets"]
            lost_packets += sent_packets.total() - arrived_packets
            sent_data, received_data = (
                (folder / file).read_bytes() for file in (transfer.sent_file, transfer.received_file)
            )
            assert values[f"{name}.file_loss"] == 1 - len(received_data) / len(sent_data)
    assert lost_packets, "the radio loses one packet in twenty"


def test_each_tcp_transfer_is_complete_and_counts_only_its_frames(trial: Path) -> None:
    for plan, folder, values in attempts(trial, Protocol.TCP):
        captures = {role: dissected(folder / f"{role}.pcap") for role in (Role.SENDER, Role.RECEIVER, Role.RELAY)}
        for transfer in planned_evidence.transfers(plan, Protocol.TCP):
            name = transfer.name
            frame_count = sum(has_port for has_port, _ in packet_keys(captures[transfer.source], transfer, TCP))
            assert values[f"{name}.ip_packets_sent"] == frame_count
            assert values[f"{name}.tcp_unique_bytes"] == (folder / transfer.sent_file).stat().st_size
            assert (values[f"{name}.byte_loss"], values[f"{name}.hash_match"]) == (0, True)


@pytest.mark.parametrize("protocol", Protocol)
def test_each_ping_and_each_capture_counts_only_its_packets(trial: Path, protocol: Protocol) -> None:
    for _, folder, values in attempts(trial, protocol):
        assert (values["load.rtt_sent"], values["rtt_sent"]) == (20, 10)
        assert (values["load.rtt_payload_bytes"], values["rtt_payload_bytes"]) == (4000, 100)
        assert values["sender_captured"] == len(dissected(folder / "sender.pcap"))
        answers = (folder / "load.ping.txt").read_text(encoding="ascii").count("bytes from")
        assert values["load.rtt_received"] == answers


def test_the_delays_of_simultaneous_transfers_are_measured(trial: Path) -> None:
    """Emulated robots share one clock, so the offset is 0; it is measured from the traffic in both directions."""
    for _, _, values in attempts(trial, Protocol.UDP):
        for name in ("up", "down"):
            offset_s, error_s = (values[f"{name}.clock_offset{suffix}_s"] for suffix in ("", "_error"))
            assert isinstance(offset_s, float)
            assert isinstance(error_s, float)
            assert abs(offset_s) <= error_s
