"""A scenario that reproduces a trial of robots: its rows compared with scapy's counts of captures, and its errors."""

from pathlib import Path

import pytest
from scapy.layers.inet import ICMP, IP, TCP, UDP
from scapy.utils import PcapReader

from fieldkit.core.columns import Value
from fieldkit.core.model import Topology
from fieldkit.trial.simulated import differences
from sim_backends.cosim import load_scenario
from sim_backends.cosim.commands.reproduced_rows import ReproducedRows
from tests.helpers.runs import Run, rows, run_here


@pytest.fixture(scope="module", params=["builtin", "ns3"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """Return the folder of a run of the shipped scenario, and its output."""
    folder = tmp_path_factory.mktemp("field")
    ns3_options = ("--network", "ns3", "--policy", "sliding_window", "--window", "5ms")
    options = ns3_options if request.param == "ns3" else ()
    result = run_here(folder, "cosim", "run", "field_30ft", *options, "--out", "simulated")
    assert result.code == 0, result.err
    return folder / "simulated", result


def test_rows_have_the_identity_and_the_columns_of_the_trial(run: tuple[Path, Run]) -> None:
    folder, _ = run
    tcp, udp = rows(folder)
    assert [row["protocol"] for row in (tcp, udp)] == ["tcp", "udp"], "the order of a trial"
    for row in (udp, tcp):
        identity = [row[name] for name in ("scenario", "topology", "distance_m", "backend", "status")]
        assert identity == ["los", "master", "9.144", "cosim", "valid"]
        assert row["sent_bytes"] == row["received_bytes"] == "230989"
    assert "started_utc_ns" not in udp

    frames = list(PcapReader(str(folder / "captures" / "sender.pcap")))
    segments = sum(TCP in frame and frame[TCP].dport == 1234 for frame in frames)
    assert int(tcp["ip_packets_sent"]) == int(tcp["paper_packets"]) == segments
    fragments = [frame for frame in frames if frame[IP].proto == 17]
    assert int(udp["ip_packets_sent"]) == len(fragments)
    assert int(udp["datagrams_sent"]) == sum(UDP in frame for frame in fragments) == 29

    received_frames = list(PcapReader(str(folder / "captures" / "receiver.pcap")))
    first_s = next(float(frame.time) for frame in received_frames if TCP in frame and frame[TCP].dport == 1234)
    last_s = max(float(frame.time) for frame in received_frames if TCP in frame and len(frame[TCP].payload))
    assert float(tcp["completion_s"]) == pytest.approx(last_s - first_s, abs=1e-5)
    assert tcp["tcp_congestion_control"] == "cubic"
    for row in (udp, tcp):
        assert float(row["goodput_bit_s"]) == pytest.approx(8 * 230989 / float(row["completion_s"]), rel=1e-6)

    for row, payload_bytes in ((udp, 8192), (tcp, 502)):
        requests = {
            frame[ICMP].seq: frame.time
            for frame in frames
            if ICMP in frame and frame[ICMP].type == 8 and row["rtt_payload_bytes"] == str(payload_bytes)
        }
        assert int(row["rtt_sent"]) == len(requests) == 10


def test_a_run_that_ends_during_a_transfer_has_a_failed_row(tmp_path: Path) -> None:
    result = run_here(tmp_path, "cosim", "run", "field_30ft", "--out", "short", "--duration", "600ms")
    assert result.code == 0, result.err
    (row,) = rows(tmp_path / "short")
    assert (row["protocol"], row["status"], row["reason"]) == (
        "udp",
        "failed",
        "the run ended before the transfer was complete",
    )
    assert "rtt_loss" not in row


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"line": "nlos"}, "the procedure los is for los, but the line of the scenario is nlos"),
        ({"traffic.1.count": "5"}, "the number of echo requests is 5, but 10 in the procedure los"),
        ({"traffic.0.port": "1235"}, "the port of the transfer is 1235, but 1234 in the procedure los"),
        ({"trial.procedure": "topics"}, "a simulation cannot reproduce the procedure"),
        ({"trial.udp.ping": "ping"}, "there is no traffic 'ping'; did you mean"),
        ({"trial.udp.ping": "scan-udp"}, "scan-udp is not traffic of kind ping with protocol udp"),
        ({"traffic.2.start": "6s"}, "the traffic of one protocol starts before all traffic of the other protocol"),
    ],
)
def test_a_value_that_contradicts_the_procedure_is_refused(
    tmp_path: Path, changes: dict[str, str], message: str
) -> None:
    options = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    result = run_here(tmp_path, "cosim", "run", "field_30ft", "--out", "run", "--duration", "10ms", *options)
    assert result.code == 2
    assert message in result.err
    assert not (tmp_path / "run").exists()


def test_the_distance_is_that_of_the_trial_in_each_topology() -> None:
    for topology, distance_m in ((Topology.MASTER, 9.144), (Topology.MASTERLESS, 18.288)):
        scenario = load_scenario("field_30ft", {"topology": topology})
        assert scenario.trial is not None
        assert ReproducedRows(scenario, scenario.trial, "event_driven")._distance().metres == distance_m


def test_a_contradiction_of_simulation_and_captures_makes_the_row_invalid() -> None:
    capture_row: dict[str, Value] = {"datagrams_sent": 29, "tcp_received_bytes": 100, "reason": "text"}
    simulation_row: dict[str, Value] = {
        "datagrams_sent": 29,
        "received_bytes": 100,
        "sent_bytes": 7,
        "reason": "other",
    }
    assert not differences(capture_row, simulation_row)
    assert differences(capture_row, {"received_bytes": 101}) == (
        "tcp_received_bytes is 100 in the captures and 101 in the simulation"
    )
