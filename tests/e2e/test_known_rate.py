"""A radio of known rate: the throughput must equal this rate and the rate in the radio's air log."""

import csv
from itertools import pairwise
from pathlib import Path

import pytest
from scapy.layers.inet import TCP
from scapy.utils import rdpcap

from tests.helpers.known_radio import make_lab, run_all
from tests.helpers.runs import Run, only_trial, rows, run_here

pytestmark = pytest.mark.emulated

REPEATS = 2
TCP_HEADERS = 20 + 32
FRAME_BYTES = 36  # MAC header, LLC/SNAP and check sequence around an IP packet
CONTROL_BYTES = 200  # smaller packets belong to ROS, not to the transfer
PAUSE_NS = 500_000_000
PORT = 1234
UDP_PACKETS = 5 * 1500 + 20 + 8192 + 8 - 5 * 1480  # of a datagram of 8,192 bytes


def test_throughput_is_the_rate_of_the_link_and_goodput_excludes_headers(tmp_path: Path) -> None:
    (table,) = run_all([make_lab(tmp_path / "lab", "{rate: 1Mbit/s}", topic="/imu", repeats=REPEATS)]).values()
    assert [row["protocol"] for row in table].count("udp") == REPEATS == len(table) / 2
    for row in table:
        assert float(row["throughput_bit_s"]) == pytest.approx(1e6, rel=0.01), row["protocol"]
        share = 8192 / UDP_PACKETS if row["protocol"] == "udp" else 1448 / (1448 + TCP_HEADERS)
        completion_s = 8 * int(row["received_bytes"]) / float(row["goodput_bit_s"])
        if row["protocol"] == "tcp":
            # The time of TCP's goodput starts at the SYN. On a busy machine, nc sends its first byte about 10 ms
            # later.
            completion_s -= before_data_s(only_trial(tmp_path / "lab") / f"repeats/tcp-{int(row['repeat']):02}")
        assert 8 * int(row["received_bytes"]) / completion_s == pytest.approx(1e6 * share, rel=0.02), row["protocol"]


def before_data_s(repeat: Path) -> float:
    """Return the time from the SYN of a transfer to its first segment with data, from the sender's capture."""
    segments = [
        packet for packet in rdpcap(str(repeat / "sender.pcap")) if TCP in packet and packet[TCP].dport == PORT
    ]
    syn = next(packet for packet in segments if packet[TCP].flags == "S")
    data = next(packet for packet in segments if len(packet[TCP].payload))
    return float(data.time) - float(syn.time)


def test_throughput_equals_that_of_the_radios_air_log(tmp_path: Path) -> None:
    """The radio's log has the time and size of each received frame; the ping starts a second after the transfer."""
    lab = make_lab(tmp_path / "air", "{fading: false}, record_air: true", topic="/imu", repeats=1)
    run: Run = run_here(lab, "trial", "quick", "5m", "--protocol", "udp", "--record", "5s")
    assert run.code == 0, run.err
    trial = only_trial(lab)
    (row,) = (row for row in rows(trial) if row["status"] == "valid")
    with (trial / "repeats" / "udp-01" / "air.csv").open(encoding="ascii", newline="") as file:
        frames = [
            (int(line["end_ns"]), int(line["size_bytes"]) - FRAME_BYTES)
            for line in csv.DictReader(file)
            if line["transmitter"] == row["sender"] and line["received"] == row["receiver"]
        ]
    frames = [(end_ns, size) for end_ns, size in frames if size > CONTROL_BYTES]
    last = next(
        (index for index, (before, after) in enumerate(pairwise(frames)) if after[0] - before[0] > PAUSE_NS),
        len(frames) - 1,
    )
    transfer_frames = frames[: last + 1]
    assert len(transfer_frames) >= 200
    rate = 8e9 * sum(size for _, size in transfer_frames[1:]) / (transfer_frames[-1][0] - transfer_frames[0][0])
    assert float(row["throughput_bit_s"]) == pytest.approx(rate, rel=0.05)
