"""Fixed links in ns-3: datagrams have the fates of the built-in network, and ns-3's TCP has the rate of the link."""

import csv
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.ns3_pair import RELAYED, arrived, reasons, run_pair, stream

LINK = {"radio.loss": "5%", "radio.delay": "2ms", "radio.rate": "3Mbit/s", "radio.jitter": "1ms"}
FAULTS = [
    {"kind": "node-loss", "agent": "bob", "from": "300ms", "to": "400ms"},
    {"kind": "link-cut", "between": ["ann", "bob"], "from": "600ms", "to": "700ms"},
    {"kind": "link-cut", "between": ["hub", "bob"], "from": "650ms", "to": "750ms"},
]


@pytest.mark.parametrize("topology", [{}, RELAYED], ids=["direct", "relay"])
@pytest.mark.parametrize("size_bytes", [800, 3000], ids=["datagrams", "fragments"])
def test_each_datagram_has_the_fate_of_the_built_in_network(
    topology: dict[str, Any], size_bytes: int, tmp_path: Path
) -> None:
    """Both have the same random draws, so each arrival is equal to the nanosecond."""
    rate = "450Hz" if size_bytes == 800 else "110Hz"
    changes = {
        **LINK,
        "agents.hub": RELAYED["agents.hub"],
        **topology,
        "radio.jitter": "1ms" if size_bytes == 800 else "0s",
        "duration": "1s",
        "traffic": stream(rate=rate, size_bytes=size_bytes),
        "faults": FAULTS,
    }
    builtin, ns3 = (run_pair(tmp_path, network, changes) for network in ("builtin", "ns3"))
    assert {identity: fate.arrived_ns for identity, fate in ns3.fates.items()} == {
        identity: fate.arrived_ns for identity, fate in builtin.fates.items()
    }
    expected = reasons(builtin)
    assert expected.keys() >= {"lost on the link", "out of range"}
    if not topology:
        assert reasons(ns3) == expected


def test_a_full_queue_drops_packets_and_an_unlimited_rate_adds_no_delay(tmp_path: Path) -> None:
    full_queue = {**LINK, "traffic": stream(rate="1kHz", size_bytes=1000)}
    builtin, ns3 = (run_pair(tmp_path, network, full_queue) for network in ("builtin", "ns3"))
    assert reasons(ns3)["queue full"] == reasons(builtin)["queue full"] > 100
    run = run_pair(tmp_path, "ns3", {"radio.delay": "7ms", "radio.rate": "unlimited", "radio.queue_packets": 0})
    assert {(fate.arrived_ns or 0) - fate.packet.enters_ns for fate in arrived(run)} == {7_000_000}


def test_the_tcp_of_ns3_has_the_rate_of_the_link(tmp_path: Path) -> None:
    """A segment of 1448 bytes has 52 bytes of headers."""
    traffic = stream(rate="200Hz", size_bytes=5000, protocol="tcp")
    changes = {"radio.delay": "1ms", "radio.rate": "2Mbit/s", "duration": "4s", "traffic": traffic}
    run = run_pair(tmp_path, "ns3", {**changes, "radio.queue_packets": 100})
    bit_s = sum(8 * fate.packet.size_bytes for fate in arrived(run)) / 4
    assert bit_s == pytest.approx(2e6 * 1448 / 1500, rel=0.05)


def test_the_parts_of_a_delay_are_those_of_the_link(tmp_path: Path) -> None:
    changes = {
        **RELAYED,
        "radio.delay": "2ms",
        "radio.rate": "1Mbit/s",
        "traffic": stream(size_bytes=972),
        "network.options.delay_parts": str(tmp_path / "parts.csv"),
    }
    run_pair(tmp_path, "ns3", changes)
    with (tmp_path / "parts.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 40
    for row in rows:
        assert int(row["propagation_ns"]) == 2 * 2_000_000
        assert int(row["transmission_ns"]) == 2 * 8_000_000
        assert int(row["queueing_ns"]) == int(row["processing_ns"]) == 0
