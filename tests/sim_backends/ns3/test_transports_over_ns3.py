"""The built-in transports over the Wi-Fi of ns-3: ROS 1, topics, TCP and UDP, with faults and captures."""

import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
from scapy.layers.inet import IP, TCP
from scapy.utils import rdpcap

from fieldkit.cli import main
from fieldkit.core.errors import ConfigurationError
from tests.helpers.ns3_pair import RELAYED, SCENARIO, arrived, reasons, run_pair, stream

MS = 1_000_000
OVER_NS3 = {"network.transports": "builtin", "network.options.standard": "802.11g", "radio.mode": "g24"}


def mean_delay_ms(network: str, changes: dict[str, Any], folder: Path) -> float:
    if network == "builtin":
        changes = {key: value for key, value in changes.items() if key != "network.options.standard"}
    fates = arrived(run_pair(folder, network, changes))
    assert len(fates) >= 9
    return sum((fate.arrived_ns or 0) - fate.packet.sent_ns for fate in fates) / len(fates) / MS


@pytest.mark.parametrize(
    ("protocol", "topology"),
    [("ros1", "master"), ("ros1-udp", "masterless"), ("topic", "master"), ("tcp", "masterless")],
)
def test_delays_are_those_of_the_built_in_radio_within_10_percent(
    protocol: str, topology: str, tmp_path: Path
) -> None:
    """A message of 2,940 bytes needs two or three frames, whose airtimes are those of the standard."""
    traffic = stream(rate="20Hz", size_bytes=2940, protocol=protocol)
    changes = {**OVER_NS3, **RELAYED, "topology": topology, "traffic": traffic}
    builtin_ms, ns3_ms = (mean_delay_ms(network, changes, tmp_path) for network in ("builtin", "ns3"))
    assert ns3_ms == pytest.approx(builtin_ms, rel=0.1)


def test_a_node_that_is_off_receives_no_messages_until_it_is_on_again(tmp_path: Path) -> None:
    node_loss = {"kind": "node-loss", "agent": "bob", "from": "200ms", "to": "300ms"}
    traffic = stream(rate="50Hz", size_bytes=500, protocol="ros1")
    run = run_pair(
        tmp_path, "ns3", {**OVER_NS3, **RELAYED, "duration": "1s", "traffic": traffic, "faults": [node_loss]}
    )
    times_ns = sorted(fate.arrived_ns or 0 for fate in arrived(run))
    assert not [at_ns for at_ns in times_ns if 200 * MS < at_ns < 300 * MS]
    # TCP retransmits lost segments; its first timeouts are 0.2 s and 0.4 s.
    assert times_ns[-1] > 300 * MS
    assert len(times_ns) > 40
    assert reasons(run).keys() <= {"", "no subscriber is connected"}


def test_a_run_has_captures_of_the_tcp_of_ros_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "line.yaml").write_text(SCENARIO, encoding="utf-8")
    words = ["cosim", "run", "line.yaml", "--network", "ns3", "--set", "network.transports=builtin"]
    words += ["--set", "traffic.0.protocol=ros1", "--set", "relay=ann", "--out", "run"]
    assert main(words) == 0
    sent_packets, received_packets = (rdpcap(str(tmp_path / f"run/captures/{name}.pcap")) for name in ("ann", "bob"))
    syn_packets = [packet for packet in received_packets if TCP in packet and packet[TCP].flags == "S"]
    assert {dict(packet[TCP].options)["MSS"] for packet in syn_packets} == {1460}
    payload_sizes = [packet[IP].len - 52 for packet in sent_packets if TCP in packet and packet[IP].src == "10.0.0.1"]
    assert max(payload_sizes) == 1448
    assert sum(payload_sizes) > 40 * 3004, "messages of 3,000 bytes with their lengths"


SIMPLE_NETWORK = """\
from sim_backends.federates.serving import serve
from sim_backends.network.disc import Disc

class Blind:
    def __init__(self, hello):
        self.advance = Disc(1000.0, 100_000).advance

serve(NETWORK, transports=TRANSPORTS)
"""


def simple_network(folder: Path, network: str, transports: str) -> str:
    program = folder / "net.py"
    text = SIMPLE_NETWORK.replace("NETWORK", network).replace("TRANSPORTS", transports)
    program.write_text(text, encoding="utf-8")
    return shlex.join((sys.executable, str(program)))


@pytest.mark.parametrize(
    ("network", "transports", "message"),
    [
        ("lambda hello: Disc(1000.0, 100_000)", "['udp']", "does not support the transport ip, ip-broadcast"),
        ("Blind", "['ip', 'ip-broadcast']", "does not report the time of its next event"),
    ],
)
def test_a_network_that_cannot_carry_ip_packets_is_refused(
    network: str, transports: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run_pair(tmp_path, simple_network(tmp_path, network, transports), {"network.transports": "builtin"})


def test_any_network_that_carries_ip_packets_supports_the_built_in_transports(tmp_path: Path) -> None:
    """Each packet needs 0.1 ms, also the two fragments of a message; hosts add no time."""
    network = simple_network(tmp_path, "lambda hello: Disc(1000.0, 100_000)", "['ip', 'ip-broadcast']")
    traffic = stream(protocol="topic", size_bytes=2000)
    run = run_pair(tmp_path, network, {"network.transports": "builtin", "traffic": traffic})
    assert reasons(run).keys() <= {"not matched yet", ""}
    delays_ns = {(fate.arrived_ns or 0) - fate.packet.enters_ns for fate in arrived(run)}
    assert delays_ns == {100_000}
