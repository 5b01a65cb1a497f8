"""The columns measured from the folder of a repeat, and the figures of the paper."""

import random
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.core.model import Protocol, Role, TrackPoint
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import track
from fieldkit.measure.transfers import delay, transfer_measures
from tests.helpers.captures import (
    PORT,
    RECEIVER,
    SENDER,
    TCPDUMP,
    Frame,
    datagram,
    file_bytes,
    ipv4,
    segment,
    timed,
    transfer,
)
from tests.helpers.measures import COLUMNS, Measures, all_columns, measure

SNMP = "==> /proc/net/snmp <==\nIp: ReasmFails\nIp: {}\nUdp: RcvbufErrors\nUdp: {}\n"
LISTENING = "tcpdump: listening on wlan0, link-type RAW (Raw IP), snapshot length 128 bytes\n"
COUNTERS = "{0} packets captured\n{0} packets received by filter\n{1} packets dropped by kernel\n"
BAG = bytes(range(256)) * 40


def _ping(payload_bytes: int, times_ms: list[float], n_sent: int) -> str:
    lines = [f"PING 10.9.0.2 (10.9.0.2) {payload_bytes}({payload_bytes + 28}) bytes of data."]
    lines += [f"64 bytes from 10.9.0.2: icmp_seq={n} ttl=64 time={time} ms" for n, time in enumerate(times_ms, 1)]
    return "\n".join([*lines, f"{n_sent} packets transmitted, {len(times_ms)} received, 0% packet loss, time 1ms"])


def _write_repeat(
    folder: Path, sent_frames: list[Frame], received_frames: list[Frame], ping: str, bag: bytes = BAG
) -> Path:
    """Write the evidence of a repeat to a folder, and return the folder. The sent file is not a bag."""
    (folder / "scan.bag").write_bytes(BAG)
    (folder / "recv.bag").write_bytes(bag)
    (folder / "sender.pcap").write_bytes(file_bytes(sent_frames))
    (folder / "receiver.pcap").write_bytes(file_bytes(received_frames))
    (folder / "sender-capture.log").write_text(LISTENING + COUNTERS.format(len(sent_frames), 0), encoding="utf-8")
    (folder / "receiver-capture.log").write_text(
        LISTENING + COUNTERS.format(len(received_frames), 2), encoding="utf-8"
    )
    (folder / "ping.txt").write_text(ping, encoding="utf-8")
    (folder / "receiver-before.txt").write_text(SNMP.format(1, 5), encoding="utf-8")
    (folder / "receiver-after.txt").write_text(SNMP.format(2, 9), encoding="utf-8")
    return folder


def _write_udp_repeat(folder: Path) -> Path:
    """36 datagrams of six fragments; the receiver lacks the first fragment of one and the last of another."""
    sent_frames = timed([packet for number in range(36) for packet in datagram(number, 8192)])
    received_frames = [frame for index, frame in enumerate(sent_frames) if index not in {6, 17}]
    times_ms = [14.0, 15.0, 16.0, 17.0, 18.0]
    return _write_repeat(folder, sent_frames, received_frames, _ping(8192, times_ms, n_sent=10), bag=BAG[:-2560])


def test_a_udp_repeat(tmp_path: Path) -> None:
    assert measure(_write_udp_repeat(tmp_path), transfer(Protocol.UDP)) == Measures(
        sent_bytes=10240,
        received_bytes=7680,
        file_loss=0.25,
        hash_match=False,
        ip_packets_sent=216,
        ip_packets_received=214,
        ip_loss=1 - 214 / 216,
        ip_packets_duplicated=0,
        ip_packets_reordered=0,
        ip_packets_doubtful=0,
        ip_loss_bursts=2,
        ip_loss_longest_burst=1,
        datagrams_sent=36,
        datagrams_received=34,
        datagram_loss=1 - 34 / 36,
        byte_loss=1 - (36 * 8192 - 1472 - 800) / (36 * 8192),
        transfer_s=0.215,
        transfer_from="receiver",
        one_way_withheld="no packet from receiver to sender is in both captures",
        delay_variation_median_s=0.0,
        delay_variation_p95_s=0.0,
        jitter_s=0.0,
        rtt_sent=10,
        rtt_received=5,
        rtt_loss=0.5,
        rtt_payload_bytes=8192,
        rtt_min_s=0.014,
        rtt_median_s=0.016,
        rtt_mean_s=0.016,
        rtt_p95_s=pytest.approx(0.0178),
        rtt_max_s=0.018,
        rtt_jitter_s=pytest.approx(0.001),
        paper_packets=36,
        paper_received=35,
        paper_window_bytes=8192,
        paper_delay_s=0.016,
        paper_transfer_s=pytest.approx(0.576),
        paper_loss=1 - 35 / 36,
        sender_captured=216,
        sender_capture_dropped=0,
        receiver_captured=214,
        receiver_capture_dropped=2,
        receiver_udp_buffer_errors=4,
        receiver_reassembly_failures=1,
        throughput_bit_s=pytest.approx(8 * (36 * 8320 - 1500 - 820 - 1500) / 0.215),
        completion_s=0.215,
        goodput_bit_s=pytest.approx(8 * (7680 - 1472) / 0.215),
        transfer_stall_s=pytest.approx(0.018),  # two consecutive datagrams lack a fragment
        transfer_stalls=0,
    )


def test_a_tcp_repeat(tmp_path: Path) -> None:
    isn = 2**32 - 2000
    sent_frames = timed(
        [segment(isn, 0, flags=2, mss=900), *(segment(isn + 1 + offset, 1000) for offset in (0, 1000, 2000, 1000))]
    )
    received_frames = [frame for index, frame in enumerate(sent_frames) if index != 2]
    measures = measure(
        _write_repeat(tmp_path, sent_frames, received_frames, _ping(502, [5.0], n_sent=1)), transfer(Protocol.TCP)
    )
    assert measures.hash_match is True
    assert (measures.ip_packets_sent, measures.ip_packets_received) == (5, 4)
    assert (measures.tcp_sent_bytes, measures.tcp_unique_bytes, measures.tcp_received_bytes) == (4000, 3000, 3000)
    assert (measures.tcp_byte_loss, measures.byte_loss, measures.tcp_retransmitted_segments) == (0.25, 0.0, 1)
    # A segment was sent twice within 2 ms and received once: it is ambiguous which of the two arrived.
    assert (measures.tcp_spurious_segments, measures.tcp_duplicated_bytes, measures.tcp_reordered_segments) == (
        None,
        0,
        None,
    )
    assert (measures.tcp_doubtful_segments, measures.tcp_superframes) == (2, 4 + 3)
    assert measures.ip_loss_bursts is measures.ip_packets_reordered is None
    assert measures.ip_loss is measures.datagrams_sent is measures.datagram_loss is None
    assert measures.transfer_s == 0.004
    assert (measures.paper_packets, measures.paper_received, measures.paper_window_bytes) == (5, 4, 502)
    assert measures.paper_transfer_s == 5 * 0.005


def test_the_papers_delay_needs_the_papers_payload(tmp_path: Path) -> None:
    folder = _write_repeat(tmp_path, [], [], _ping(56, [5.0], n_sent=1))
    measures = measure(folder, transfer(Protocol.TCP))
    assert (measures.rtt_mean_s, measures.paper_delay_s, measures.paper_transfer_s) == (0.005, None, None)


COLUMNS_BY_FILE = {
    "scan.bag": {"sent_bytes", "file_loss", "hash_match"},
    "recv.bag": {"received_bytes", "file_loss", "hash_match", "goodput_bit_s"},
    "sender-capture.log": {"sender_capture_dropped"},
    "receiver-capture.log": {"receiver_capture_dropped"},
    "receiver-before.txt": {"receiver_udp_buffer_errors", "receiver_reassembly_failures"},
    "receiver-after.txt": {"receiver_udp_buffer_errors", "receiver_reassembly_failures"},
}
RATES = ("throughput_bit_s", "completion_s", "goodput_bit_s")
FROM_BOTH_CAPTURES = ("ip_", "datagram", "byte_", "transfer", "one_way_withheld", "delay_variation", "jitter", *RATES)
# The pings here have no time stamps, so only the transfer has distances from the track.
FROM_TRACK = {name for name in COLUMNS if "_distance_" in name or "_speed_" in name}
COLUMNS_BY_FILE["track.csv"] = {name for name in FROM_TRACK if name.startswith("transfer_")}
# All stalls of this transfer have ended.
CAPTURE_COLUMNS = (
    {name for name in COLUMNS if name.startswith(FROM_BOTH_CAPTURES)} - FROM_TRACK - {"transfer_stall_at_least_s"}
)
COLUMNS_BY_FILE["sender.pcap"] = (
    CAPTURE_COLUMNS
    | COLUMNS_BY_FILE["track.csv"]
    | {"paper_packets", "paper_transfer_s", "paper_loss", "sender_captured"}
)
COLUMNS_BY_FILE["receiver.pcap"] = CAPTURE_COLUMNS | {"paper_received", "paper_loss", "receiver_captured"}
HALF_LOST = {"rtt_median_sent_s"}  # as in the pings of this module
COLUMNS_BY_FILE["ping.txt"] = {
    name for name in COLUMNS if name.startswith("rtt_") or name in {"paper_delay_s", "paper_transfer_s"}
} - (FROM_TRACK | HALF_LOST)


@pytest.mark.parametrize("missing", COLUMNS_BY_FILE)
def test_missing_evidence_empties_only_the_columns_that_depend_on_it(tmp_path: Path, missing: str) -> None:
    folder = _write_udp_repeat(tmp_path)
    track_text = track.text(TrackPoint(0, role, (1.0, 2.0, 0.2)) for role in (Role.SENDER, Role.RECEIVER))
    (folder / "track.csv").write_text(track_text, encoding="ascii")
    columns_before = all_columns(measure(folder, transfer(Protocol.UDP)))
    (folder / missing).unlink()
    columns_after = all_columns(measure(folder, transfer(Protocol.UDP)))
    assert {name for name in columns_before if columns_before[name] != columns_after[name]} == COLUMNS_BY_FILE[
        missing
    ]
    assert all(columns_after[name] is None for name in COLUMNS_BY_FILE[missing])


@pytest.mark.parametrize("protocol", Protocol)
def test_captures_around_another_step_are_not_used_for_a_transfer(tmp_path: Path, protocol: Protocol) -> None:
    """The captures belong to a ping after the transfer, so their content shows nothing about the transfer."""
    _write_udp_repeat(tmp_path)
    (tmp_path / "receiver.pcap").write_bytes(file_bytes([]))
    measures = transfer_measures.measure(
        AttemptEvidence(tmp_path), replace(transfer(protocol), captures=(None, None))
    )
    missing_names = {name for name in CAPTURE_COLUMNS if name in measures.missing}
    assert measures.values.keys().isdisjoint(CAPTURE_COLUMNS | {"paper_packets", "paper_received"})
    assert {measures.missing[name] for name in missing_names} == {"there are no complete captures of both ends"}
    assert (measures.values["sent_bytes"], measures.values["received_bytes"]) == (10240, 7680)


def test_a_damaged_capture_is_not_counted(tmp_path: Path) -> None:
    folder = _write_udp_repeat(tmp_path)
    path = folder / "receiver.pcap"
    path.write_bytes(path.read_bytes()[:-1])
    measures = measure(folder, transfer(Protocol.UDP))
    assert (
        measures.ip_packets_received
        is measures.ip_loss
        is measures.receiver_captured
        is measures.paper_received
        is None
    )


def test_an_empty_folder_gives_only_the_papers_window(tmp_path: Path) -> None:
    assert measure(tmp_path, transfer(Protocol.TCP)) == Measures(paper_window_bytes=502)


def test_an_interrupted_ping_gives_times_but_no_loss(tmp_path: Path) -> None:
    folder = _write_udp_repeat(tmp_path)
    path = folder / "ping.txt"
    path.write_text("\n".join(path.read_text(encoding="utf-8").split("\n")[:-1]), encoding="utf-8")
    measures = measure(folder, transfer(Protocol.UDP))
    assert (measures.rtt_sent, measures.rtt_loss) == (None, None)
    assert (measures.rtt_received, measures.rtt_median_s) == (5, 0.016)


@pytest.mark.parametrize(
    ("packets", "delay_s", "transfer_s"),
    [(36, 0.016, 0.576), (207, 0.005, 1.035), (36, 0.013, 0.468), (207, 0.0045, 0.9315)],
)
def test_figures_printed_in_the_paper(packets: int, delay_s: float, transfer_s: float) -> None:
    assert transfer_measures.paper_transfer_s(packets, delay_s) == pytest.approx(transfer_s)


@pytest.mark.emulated
@pytest.mark.parametrize("seed", range(3))
def test_filters_of_the_paper_count_the_same_packets_as_tcpdump(tmp_path: Path, seed: int) -> None:
    random_generator = random.Random(seed)
    data = [packet for number in range(5) for packet in datagram(number, 8192)]
    data += [
        segment(0, size, sport=sport, port=port) for size, sport, port in ((0, 9, PORT), (5, PORT, 9), (5, 9, 9))
    ]
    mirrored = [packet[:12] + packet[16:20] + packet[12:16] + packet[20:] for packet in data]
    frames = timed(random_generator.sample([*data, *mirrored], 50))
    path = tmp_path / "x.pcap"
    path.write_bytes(file_bytes(frames))
    measures = measure(_write_repeat(tmp_path, frames, frames, ""), transfer(Protocol.UDP))
    for count, expression in (
        (measures.paper_packets, f"src {SENDER} and port {PORT}"),
        (measures.paper_received, f"dst {RECEIVER} and port {PORT}"),
    ):
        command = ["tcpdump", "-n", "-r", str(path), expression]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert count == len(output.splitlines()) > 0


def test_real_captures_of_the_papers_file_without_loss(tmp_path: Path) -> None:
    for protocol in Protocol:
        data = (TCPDUMP / f"nc-{protocol}.pcap").read_bytes()
        (tmp_path / "sender.pcap").write_bytes(data)
        (tmp_path / "receiver.pcap").write_bytes(data)
        loopback = replace(transfer(protocol), sender_address="127.0.0.1", receiver_address="127.0.0.1", port=1234)
        measures = measure(tmp_path, loopback)
        assert measures.byte_loss == 0
        if protocol is Protocol.UDP:
            assert (measures.ip_packets_received, measures.datagrams_received, measures.paper_packets) == (
                215,
                36,
                36,
            )
        else:
            assert (measures.tcp_unique_bytes, measures.tcp_byte_loss) == (293_797, 0)


def test_a_forged_capture_empties_only_the_columns_of_the_transfer(tmp_path: Path) -> None:
    forged_packets = timed([segment(index, 60_000 * (index > 0), flags=0x02 * (index == 0)) for index in range(3000)])
    measures = measure(
        _write_repeat(tmp_path, forged_packets, forged_packets[:1], _ping(502, [5.0], n_sent=1)),
        transfer(Protocol.TCP),
    )
    assert (measures.tcp_sent_bytes, measures.ip_packets_sent) == (None, None)
    assert (measures.rtt_received, measures.sender_captured) == (1, 3000)


def test_a_clock_that_was_set_empties_all_times(tmp_path: Path) -> None:
    """The receiver's clock is set forward by an hour during the transfer: 30 ms would appear as 3600 s."""
    sent_frames = timed(
        [segment(0, 0, flags=2), *(segment(1 + 1000 * index, 1000, ip_id=index) for index in range(20))]
    )
    ack = struct.pack(">HHIIBBHHH", PORT, 40000, 1, 1, 5 << 4, 0x10, 502, 0, 0)
    answers = [
        Frame(frame.time_ns + 500_000, ipv4(ack, protocol=6, ip_id=number, src=RECEIVER, dst=SENDER))
        for number, frame in enumerate(sent_frames)
    ]
    frames = sorted([*sent_frames, *answers], key=lambda frame: frame.time_ns)
    hour_ns = 3600 * 10**9
    received_frames = [
        replace(frame, time_ns=frame.time_ns + hour_ns * (index > 20)) for index, frame in enumerate(frames)
    ]
    measures_of_steady_clock = measure(
        _write_repeat(tmp_path, frames, frames, _ping(502, [5.0], n_sent=1)), transfer(Protocol.TCP)
    )
    assert measures_of_steady_clock.transfer_s == pytest.approx(0.02)
    measures_of_set_clock = measure(
        _write_repeat(tmp_path, frames, received_frames, _ping(502, [5.0], n_sent=1)), transfer(Protocol.TCP)
    )
    assert measures_of_set_clock.one_way_withheld == delay.UNSTEADY
    assert (
        measures_of_set_clock.transfer_s
        is measures_of_set_clock.transfer_from
        is measures_of_set_clock.jitter_s
        is None
    )
    assert measures_of_set_clock.tcp_byte_loss == 0
