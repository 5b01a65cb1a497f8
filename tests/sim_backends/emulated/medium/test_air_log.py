"""Radio transmissions as a capture and a table, read equally by fieldkit and scapy."""

import csv
import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from scapy.layers.dot11 import Dot11
from scapy.layers.inet import ICMP
from scapy.utils import rdpcap

from benchmarks.namespaces import Namespace
from fieldkit.config.profiles import Radio
from fieldkit.measure.captures import pcap
from sim_backends.emulated.medium import air_files
from sim_backends.emulated.medium.air_log import AirLog
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.mac.frames import ControlFrame, TransmissionAttempt
from sim_backends.radio.phy.modes import G_MODES
from sim_backends.radio.radio_options import RadioOptions
from tests.helpers.known_radio import make_lab
from tests.helpers.runs import only_trial, rows, run_here

RADIO = Radio(interface="wlan0", standard="802.11g", tx_power_dbm=17, sensitivity_dbm=-82)
ADDRESSES = {"a": "10.9.0.1", "b": "10.9.0.2", "r": "10.9.0.3"}
MAC = {"a": "02:00:00:00:00:01", "b": "02:00:00:00:00:02", "r": "02:00:00:00:00:03"}


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / air_files.CSV).open(encoding="ascii", newline="") as file:
        return list(csv.DictReader(file))


def attempt(number: int, payload: bytes = b"\x45" + bytes(99)) -> TransmissionAttempt:
    return TransmissionAttempt(1000, 51_000, "a", "b", G_MODES[0], len(payload) + 36, number, ("b",), payload)


def test_both_files_stop_at_their_limit(tmp_path: Path) -> None:
    paths = [tmp_path / air_files.PCAP, tmp_path / air_files.CSV]
    log = AirLog([os.open(path, os.O_WRONLY | os.O_CREAT) for path in paths], ("a", "b"), limit_bytes=10_000)
    for _ in range(100):
        log.write(attempt(1))
    log.close()
    assert 9_700 < sum(path.stat().st_size for path in paths) <= 10_000
    assert pcap.read(paths[0]).damage is None
    assert pcap.read(paths[0]).frames == len(table(tmp_path)) > 30


def test_a_retry_is_marked_and_long_frames_are_cut(tmp_path: Path) -> None:
    paths = [tmp_path / air_files.PCAP, tmp_path / air_files.CSV]
    log = AirLog([os.open(path, os.O_WRONLY | os.O_CREAT) for path in paths], ("a", "b"))
    for number in (1, 2):
        log.write(attempt(number, b"\x45" + bytes(1499)))
    log.close()
    first, second = rdpcap(str(paths[0]))
    assert ("retry" in first[Dot11].FCfield, "retry" in second[Dot11].FCfield) == (False, True)
    assert (first.wirelen, len(first)) == (1532, 160)


def test_control_frames_have_their_type_and_addresses(tmp_path: Path) -> None:
    paths = [tmp_path / air_files.PCAP, tmp_path / air_files.CSV]
    log = AirLog([os.open(path, os.O_WRONLY | os.O_CREAT) for path in paths], ("a", "b"))
    frames_sent: tuple[tuple[ControlFrame, int], ...] = (("RTS", 20), ("CTS", 14), ("ACK", 14))
    for control, size_bytes in frames_sent:
        log.write(TransmissionAttempt(1000, 51_000, "a", "b", G_MODES[0], size_bytes, 0, ("b",), None, control))
    log.close()
    frames = rdpcap(str(paths[0]))
    assert [(frame.type, frame.subtype, frame.addr1) for frame in frames] == [
        (1, subtype, MAC["b"]) for subtype in (11, 12, 13)
    ]
    assert frames[0].addr2 == MAC["a"]


@pytest.fixture
def bench() -> Iterator[tuple[MediumClient, dict[str, Namespace]]]:
    with ExitStack() as stack:
        medium = stack.enter_context(MediumClient(RadioOptions(fading=False), seed=1))
        spaces = {name: stack.enter_context(Namespace()) for name in ADDRESSES}
        for name, space in spaces.items():
            fd = space.tun("wlan0", f"{ADDRESSES[name]}/24")
            medium.attach(name, f"{ADDRESSES[name]}/24", RADIO, fd)
            os.close(fd)
        medium.place({"a": (0.0, 0.0, 0.0), "b": (9.0, 0.0, 0.0), "r": (4.5, 0.0, 0.0)}, relay="r")
        yield medium, spaces


@pytest.mark.emulated
def test_each_hop_of_a_ping_is_in_both_files(
    bench: tuple[MediumClient, dict[str, Namespace]], tmp_path: Path
) -> None:
    medium, spaces = bench
    medium.record(tmp_path)
    assert spaces["a"].run("ping", "-c", "1", ADDRESSES["b"]).returncode == 0
    medium.record(None)
    spaces["a"].run("ping", "-c", "1", ADDRESSES["b"])
    all_lines = table(tmp_path)
    lines = [line for line in all_lines if line["size_bytes"] == str(84 + 36)]
    hops = [("a", "r"), ("r", "b"), ("b", "r"), ("r", "a")]
    assert [(line["transmitter"], line["receiver"]) for line in lines] == hops
    assert [line["received"] for line in lines] == [receiver for _, receiver in hops]
    frames = [frame for frame in rdpcap(str(tmp_path / air_files.PCAP)) if ICMP in frame]
    assert [(frame.addr2, frame.addr1) for frame in frames] == [
        (MAC[sender], MAC[receiver]) for sender, receiver in hops
    ]
    assert [frame[ICMP].type for frame in frames] == [8, 8, 0, 0]
    acks = [frame for frame in rdpcap(str(tmp_path / air_files.PCAP)) if (frame.type, frame.subtype) == (1, 13)]
    assert {(frame.addr1, len(frame)) for frame in acks} >= {(MAC[sender], 10) for sender, _ in hops}
    assert len(acks) == sum(line["attempt"] == "0" for line in all_lines)
    capture = pcap.read(tmp_path / air_files.PCAP)
    assert capture.damage is None
    assert capture.frames == len(table(tmp_path))
    starts_ns = [int(line["start_ns"]) for line in all_lines if line["attempt"] != "0"]
    assert capture.packets.time_ns.tolist() == starts_ns
    assert all(int(line["end_ns"]) > int(line["start_ns"]) for line in lines)


@pytest.mark.emulated
def test_a_site_file_with_record_air_adds_the_files_to_the_evidence(tmp_path: Path) -> None:
    lab = make_lab(tmp_path / "air", "{fading: false}, record_air: true")
    run = run_here(lab, "trial", "quick", "5m", "--repeats", "1", "--protocol", "udp")
    assert run.code == 0, run.err
    trial = only_trial(lab)
    assert f"lab_bytes: {air_files.LIMIT_BYTES}" in (trial / "trial.yaml").read_text(encoding="utf-8")
    (row,) = [row for row in rows(trial) if row["status"] == "valid"]
    (folder,) = (trial / "repeats").glob("udp-01")
    sent_lines = [line for line in table(folder) if line["transmitter"] == row["sender"] and line["attempt"] == "1"]
    assert len(sent_lines) >= int(row["ip_packets_sent"]) > 0
    assert pcap.read(folder / air_files.PCAP).frames == len(table(folder))
    assert run_here(lab, "verify", str(trial)).code == 0
