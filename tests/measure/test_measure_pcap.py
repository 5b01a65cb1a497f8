import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.config import conf
from scapy.layers.inet import ICMP, IP, TCP, UDP, fragment
from scapy.layers.inet6 import IPv6
from scapy.layers.l2 import ARP, CookedLinux, CookedLinuxV2, Ether
from scapy.packet import Packet, Raw
from scapy.utils import PcapReader, PcapWriter

from fieldkit.errors import EvidenceError
from fieldkit.measure import pcap
from fieldkit.measure.packets import NO_PORT, Packets
from tests.measure.captures import RECEIVER, SENDER, TCPDUMP, Frame, file_bytes, ipv4, segment, timed

LINKS = {
    1: Ether(src="02:00:00:00:00:01", dst="02:00:00:00:00:02"),
    12: None,
    101: None,
    113: CookedLinux(proto=0x0800),
    276: CookedLinuxV2(proto=0x0800),
}


def _ip_packets() -> list[Packet]:
    there = IP(src=SENDER, dst=RECEIVER)
    back = IP(src=RECEIVER, dst=SENDER)
    with_options = IP(src=SENDER, dst=RECEIVER, options=[b"\x94\x04\x00\x00"])
    one = IP(src=SENDER, dst=RECEIVER, id=7) / UDP(sport=4, dport=5) / Raw(bytes(20))
    big = IP(src=SENDER, dst=RECEIVER, id=65535) / UDP(sport=40000, dport=1234) / Raw(bytes(8192))
    # The last offsets need all 13 bits of the field.
    biggest = IP(src=SENDER, dst=RECEIVER, id=1) / UDP(sport=40000, dport=1234) / Raw(bytes(65_507))
    return [
        one,
        *fragment(biggest, 8000),  # type: ignore[no-untyped-call]
        *fragment(big, 1480),  # type: ignore[no-untyped-call]
        there / TCP(sport=1234, dport=40000, seq=2**32 - 1, flags="S", options=[("MSS", 1460), ("WScale", 7)]),
        back / TCP(sport=40000, dport=1234, seq=1, flags="PA") / Raw(bytes(1448)),
        with_options / TCP(sport=1, dport=65535, flags="FA") / Raw(b"abc"),
        there / ICMP() / Raw(bytes(56)),
    ]


def _write(path: Path, frames: Sequence[Packet], link_type: int, order: str, *, nano: bool) -> None:
    writer = PcapWriter(str(path), linktype=link_type, endianness=order, nano=nano)
    for index, frame in enumerate(frames):
        frame.time = 1_700_000_000 + index * 0.25
        writer.write(frame)
    writer.close()


def _dissected(path: Path) -> list[tuple[int, ...]]:
    """What scapy's own dissector reads from the file."""
    found: list[tuple[int, ...]] = []
    for frame in PcapReader(str(path)):
        if IP not in frame:
            continue
        ip = frame[IP]
        first = ip.frag == 0
        tcp = frame[TCP] if first and TCP in frame else None
        udp = frame[UDP] if first and UDP in frame else None
        ported = tcp or udp
        found.append((
            round(frame.time * 10**9),
            frame.wirelen or len(frame),
            int.from_bytes(bytes(map(int, ip.src.split("."))), "big"),
            int.from_bytes(bytes(map(int, ip.dst.split("."))), "big"),
            ip.proto,
            ip.id,
            ip.frag * 8,
            int("MF" in str(ip.flags)),
            ip.len - ip.ihl * 4,
            ported.sport if ported else -1,
            ported.dport if ported else -1,
            tcp.seq if tcp else 0,
            int(tcp.flags) if tcp else 0,
            ip.len - ip.ihl * 4 - tcp.dataofs * 4 if tcp else 0,
            udp.len if udp else 0,
        ))  # fmt: skip
    return found


def _rows(packets: Packets) -> list[tuple[int, ...]]:
    names = list(Packets.__dataclass_fields__)
    return list(zip(*(getattr(packets, name).astype(int).tolist() for name in names), strict=True))


@pytest.mark.parametrize("link_type", LINKS)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nano", [False, True])
def test_every_column_equals_what_scapy_dissects(tmp_path: Path, link_type: int, order: str, nano: bool) -> None:
    # scapy knows link type 12 by its number on this system only.
    conf.l2types.register_num2layer(12, IP)
    link = LINKS[link_type]
    frames = [packet if link is None else link / packet for packet in _ip_packets()]
    path = tmp_path / "x.pcap"
    _write(path, frames, link_type, order, nano=nano)

    capture = pcap.read(path)

    assert _rows(capture.packets) == _dissected(path)
    assert len(capture.packets) == len(frames) > 8
    assert (capture.frames, capture.other_frames, capture.damage) == (len(frames), 0, None)


def test_frames_that_are_no_ipv4_are_counted(tmp_path: Path) -> None:
    link = LINKS[1]
    assert link is not None
    padded = link / IP(src=SENDER, dst=RECEIVER) / UDP(sport=1, dport=2) / Raw(b"x")
    frames = [Ether() / ARP(), padded, Ether() / IPv6() / UDP()]
    _write(tmp_path / "x.pcap", frames, 1, "<", nano=False)
    capture = pcap.read(tmp_path / "x.pcap")
    assert (capture.frames, capture.other_frames, len(capture.packets)) == (3, 2, 1)


def test_payload_is_told_by_the_ip_header_not_by_ethernet_padding_or_what_was_kept() -> None:
    head = segment(5, 1448)
    ethernet = bytes(12) + b"\x08\x00"
    short = ethernet + ipv4(bytes(12), protocol=17, size=9) + bytes(20)
    data = file_bytes([Frame(0, ethernet + head, wire_bytes=14 + 1488), Frame(1, short)], link_type=1)
    packets = pcap.parse(data, where="x").packets
    assert packets.tcp_payload_bytes.tolist() == [1448, 0]
    assert packets.ip_payload_bytes.tolist() == [1468, 9]


def test_padding_is_not_taken_for_a_transport_header() -> None:
    ethernet = bytes(12) + b"\x08\x00"
    frame = ethernet + ipv4(b"\x04\xd2\x04\xd2", protocol=17) + b"\xff" * 22
    packets = pcap.parse(file_bytes([Frame(0, frame)], link_type=1), where="x").packets
    assert (packets.dport.tolist(), packets.udp_bytes.tolist()) == ([1234], [0])


def test_a_super_frame_above_64_kib_takes_its_length_from_the_wire() -> None:
    huge = segment(5, 0)
    huge = huge[:2] + b"\x00\x00" + huge[4:]
    packets = pcap.parse(file_bytes([Frame(0, huge, wire_bytes=40 + 100_000)]), where="x").packets
    assert packets.tcp_payload_bytes.tolist() == [100_000]


def test_a_packet_cut_within_its_headers_has_no_ports() -> None:
    whole = segment(5, 0)
    for kept, frames, ported in ((19, 0, 0), (23, 1, 0), (24, 1, 1), (39, 1, 1)):
        packets = pcap.parse(file_bytes([Frame(0, whole[:kept], wire_bytes=40)]), where="x").packets
        assert len(packets) == frames
        assert (packets.dport != NO_PORT).sum() == ported
        assert not packets.tcp_seq.any()


@pytest.mark.parametrize("link_type", LINKS)
def test_a_capture_without_packets_is_whole(link_type: int) -> None:
    capture = pcap.parse(file_bytes([], link_type=link_type), where="x")
    assert (capture.frames, capture.damage, len(capture.packets)) == (0, None, 0)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "is empty"),
        (b"#ROSBAG V2.0\n" + bytes(100), "not a classic pcap"),
        (b"\x0a\x0d\x0d\x0a" + bytes(100), "not a classic pcap"),
        (file_bytes([])[:23], "not a classic pcap"),
        (file_bytes([], link_type=127), "link type 127"),
    ],
)
def test_what_is_no_capture_is_refused_with_a_remedy(data: bytes, what: str) -> None:
    with pytest.raises(EvidenceError, match=what) as caught:
        pcap.parse(data, where="sender.pcap")
    assert caught.value.remedy
    assert caught.value.where == "sender.pcap"


def test_a_missing_capture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="No such file"):
        pcap.read(tmp_path / "none.pcap")


FRAMES = timed([segment(index * 100, 100) for index in range(5)])
SOUND = file_bytes(FRAMES)
RECORD = 16 + 40


@pytest.mark.parametrize("size", range(24, len(SOUND)))
def test_a_truncated_file_gives_the_packets_before_the_cut(size: int) -> None:
    capture = pcap.parse(SOUND[:size], where="x")
    whole, rest = divmod(size - 24, RECORD)
    assert capture.packets.tcp_seq.tolist() == [index * 100 for index in range(whole)]
    if rest == 0:
        assert capture.damage is None
    else:
        assert capture.damage == f"ends inside the packet at byte {24 + whole * RECORD}, after packet {whole}"


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (4, b"\x00\xca\x9a\x3b"),  # 10^9 nanoseconds in a second
        (8, b"\x01\x00\x04\x00" * 2),  # 262,145 bytes kept
        (12, b"\x27\x00\x00\x00"),  # 39 bytes on the wire of which 40 were kept
    ],
)
def test_a_broken_record_header_ends_the_packets_and_is_named(at: int, value: bytes) -> None:
    start = 24 + 2 * RECORD
    data = SOUND[: start + at] + value + SOUND[start + at + len(value) :]
    capture = pcap.parse(data, where="x")
    assert capture.packets.tcp_seq.tolist() == [0, 100]
    assert capture.damage == f"no packet header at byte {start}, after packet 2"


@given(st.integers(24, len(SOUND) - 1), st.integers(0, 7))
def test_one_flipped_bit_never_raises_and_leaves_the_packets_before_it(at: int, bit: int) -> None:
    data = bytearray(SOUND)
    data[at] ^= 1 << bit
    capture = pcap.parse(bytes(data), where="x")
    before = (at - 24) // RECORD
    assert capture.packets.tcp_seq.tolist()[:before] == [index * 100 for index in range(before)]


@given(st.binary(max_size=400))
def test_arbitrary_records_never_raise(data: bytes) -> None:
    for link_type in LINKS:
        pcap.parse(file_bytes([], link_type=link_type) + data, where="x")


def test_a_real_capture_of_the_papers_file_over_udp() -> None:
    # 293,797 bytes through nc.traditional -u: 36 datagrams of 8,192 bytes, 215 fragments (field notes).
    packets = pcap.read(TCPDUMP / "nc-udp.pcap").packets
    assert len(packets) == 215
    assert (packets.dport == 1234).sum() == 36
    assert packets.udp_bytes.sum() - 36 * 8 == 293_797
    assert packets.ip_payload_bytes.sum() - 36 * 8 == 293_797


def test_a_real_capture_of_any_interface() -> None:
    capture = pcap.read(TCPDUMP / "any.pcap")
    assert (capture.frames, capture.packets.protocol.tolist()) == (1, [1])


@pytest.mark.emulated
@pytest.mark.parametrize("name", ["nc-udp", "nc-tcp"])
def test_sizes_and_times_equal_what_tcpdump_prints(name: str) -> None:
    path = TCPDUMP / f"{name}.pcap"
    printed = subprocess.run(
        ["tcpdump", "-n", "-tt", "-v", "-r", str(path)], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    heads = [line for line in printed if "length" in line and line[0].isdigit()]
    packets = pcap.read(path).packets
    lengths = [int(line.rsplit("length ", 1)[1].rstrip(")")) for line in heads]
    assert lengths == (packets.wire_bytes - 14).tolist()
    stamps = [line.split()[0].replace(".", "") + "000" for line in heads]
    assert np.array(stamps).astype(np.int64).tolist() == packets.time_ns.tolist()
