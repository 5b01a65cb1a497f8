"""pcapng: all block types with packets, sections, interfaces, clocks, and damage at any position."""

import struct
from contextlib import suppress
from fractions import Fraction
from itertools import accumulate
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scapy.utils import PcapNgWriter, PcapReader, rdpcap

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from tests.helpers.blocks import block, enhanced, file_bytes_of, interface, obsolete, option, section, simple
from tests.helpers.captures import TCPDUMP, Frame, file_bytes, segment, timed
from tests.helpers.dissected import rows

T_NS = 1_700_000_000_123_456_789


def _frame(seq: int, *, pad: int = 0) -> Frame:
    return Frame(T_NS + seq, segment(seq, 100) + bytes(pad), wire_bytes=140 + pad)


@pytest.mark.parametrize("order", ["<", ">"])
def test_every_block_type_that_contains_a_packet(order: str) -> None:
    ticks = T_NS // 1000
    data = b"".join([
        section(order=order),
        interface(order=order, snap=40),
        enhanced(_frame(1, pad=1), ticks=ticks, order=order, comment=b"hello"),
        block(4, bytes(8), order=order),  # name resolution
        obsolete(_frame(2), ticks=ticks + 1, drops=77, order=order),
        block(0x0BAD, b"x" * 33, order=order),
        simple(_frame(3), order=order),
        block(5, bytes(12), order=order),  # statistics
    ])  # fmt: skip
    capture = pcap.parse(data, where="x")
    assert (capture.frames, capture.damage) == (3, None)
    assert capture.packets.tcp_seq.tolist() == [1, 2, 3]
    assert capture.packets.wire_bytes.tolist() == [141, 140, 140]
    assert capture.packets.time_ns.tolist() == [ticks * 1000, (ticks + 1) * 1000, NO_TIME]


def test_a_simple_packet_has_the_snap_length_of_its_interface() -> None:
    packet = segment(7, 100)
    for snap, captured, has_ports in ((0, 40, True), (40, 40, True), (24, 24, True), (23, 23, False)):
        data = section() + interface(snap=snap) + simple(Frame(0, packet[:captured], wire_bytes=40))
        packets = pcap.parse(data, where="x").packets
        assert (packets.dport == 1234).tolist() == [has_ports]
        assert packets.tcp_seq.tolist() == [7 if captured == 40 else 0]


@pytest.mark.parametrize("order", ["<", ">"])
def test_each_section_and_interface_has_its_own_byte_order_and_clock(order: str) -> None:
    ethernet = Frame(0, bytes(12) + b"\x08\x00" + segment(2, 100))
    other_order = "<" if order == ">" else ">"
    data = b"".join([
        section(order=order),
        interface(order=order, resolution=9),
        interface(1, order=order, resolution=3, offset_s=100),
        enhanced(_frame(1), ticks=T_NS, order=order),
        enhanced(ethernet, ticks=5, number=1, order=order),
        interface(147, order=order),
        enhanced(Frame(0, b"unknown"), ticks=5, number=2, order=order),
        obsolete(ethernet, ticks=6, number=1, order=order),
        section(order=other_order),
        interface(1, order=other_order, resolution=0),
        enhanced(ethernet, ticks=7, order=other_order),
    ])  # fmt: skip
    capture = pcap.parse(data, where="x")
    assert (capture.frames, capture.frames - len(capture.packets), capture.damage) == (5, 1, None)
    assert capture.packets.tcp_seq.tolist() == [1, 2, 2, 2]
    assert capture.packets.time_ns.tolist() == [T_NS, 100_005_000_000, 100_006_000_000, 7_000_000_000]


@given(st.integers(0, 255), st.integers(0, 2**64 - 1), st.integers(-(10**9), 10**9))
@example(128 + 34, 2**64 - 1, 0)
@example(128 + 35, 2**64 - 1, 0)
@example(19, 2**64 - 1, -1)
@example(9, T_NS, 3)
def test_times_equal_exact_fractions(resolution: int, ticks: int, offset_s: int) -> None:
    base = 2 if resolution & 0x80 else 10
    exact_s = Fraction(ticks, base ** (resolution & 0x7F)) + offset_s
    expected = int(exact_s * 10**9 // 1)
    # Times that do not fit into 64 bits may be wrong, but raise no error.
    data = section() + interface(resolution=resolution, offset_s=offset_s) + enhanced(_frame(1), ticks=ticks)
    times_ns = pcap.parse(data, where="x").packets.time_ns.tolist()
    assert times_ns == [expected] or abs(expected) >= 2**63


def test_a_file_with_only_unsupported_link_types_is_rejected() -> None:
    data = section() + interface(147) + interface(148)
    assert pcap.parse(data, where="x").frames == 0
    with pytest.raises(EvidenceError, match="no link type that fieldkit can read: 147, 148") as error_info:
        pcap.parse(data + enhanced(_frame(1), ticks=1), where="x")
    assert error_info.value.remedy


BLOCKS = [
    section(),
    interface(resolution=9),
    *(enhanced(_frame(index, pad=index), ticks=T_NS + index) for index in (0, 1, 2)),
    block(5, bytes(12)),
    section(order=">"),
    interface(order=">", snap=40, offset_s=1),
    obsolete(_frame(3), ticks=T_NS // 1000, order=">"),
    simple(_frame(4), order=">"),
    interface(1, order=">"),
    enhanced(_frame(5), ticks=T_NS // 1000, order=">"),
]
VALID = b"".join(BLOCKS)
ENDS = list(accumulate(map(len, BLOCKS)))
PACKET_ENDS = [ENDS[index] for index in (2, 3, 4, 8, 9, 11)]


def test_a_truncated_file_gives_the_packets_before_the_cut() -> None:
    for size in range(28, len(VALID) + 1):
        capture = pcap.parse(VALID[:size], where="x")
        n_complete = sum(end <= size for end in PACKET_ENDS)
        assert capture.packets.tcp_seq.tolist() == list(range(n_complete))
        start = max(end for end in ENDS if end <= size)
        damage = f"ends inside the block at byte {start}, after packet {n_complete}"
        assert capture.damage == (None if size == start else damage)


def _damage_block(index: int, offset: int, value: bytes) -> bytes:
    start = ENDS[index] - len(BLOCKS[index])
    return VALID[: start + offset] + value + VALID[start + offset + len(value) :]


@pytest.mark.parametrize(
    ("index", "offset", "value", "damage"),
    [
        (3, 4, b"\x00\x00\x00\x00", "no block"),
        (3, 4, b"\x0b\x00\x00\x00", "no block"),
        (3, 4, b"\xff\xff\xff\xff", "ends inside the block"),
        (3, len(BLOCKS[3]) - 4, b"\x00", "no packet block"),
        (3, 8, b"\x01\x00\x00\x00", "no packet block"),  # an interface that is not defined
        (3, 20, b"\xf0\x00\x00\x00", "no packet block"),  # more captured than wire bytes
        (3, 20, b"\x2d\x00\x00\x00", "no packet block"),  # more captured bytes than the block contains
        (5, len(BLOCKS[5]) - 4, b"\x00", "no block"),
        (6, 8, b"\x00", "no block"),
        (7, 4, b"\x00\x00\x00\x0c", "no block"),
        (7, 18, b"\xff\xff", "no block"),  # an option that is longer than its block
    ],
)
def test_packets_before_a_broken_block_are_read_and_the_damage_is_reported(
    index: int, offset: int, value: bytes, damage: str
) -> None:
    capture = pcap.parse(_damage_block(index, offset, value), where="x")
    start = ENDS[index] - len(BLOCKS[index])
    n_before = sum(end <= start for end in PACKET_ENDS)
    assert capture.packets.tcp_seq.tolist() == list(range(n_before))
    assert capture.damage == f"{damage} at byte {start}, after packet {n_before}"


@pytest.mark.parametrize(
    "header", [b"\x0a\x0d\x0d\x0a", b"\x0a\x0d\x0d\x0a" + bytes(100), section()[:27], section()[:-1] + b"\x01"]
)
def test_a_file_without_a_section_header_is_rejected(header: bytes) -> None:
    with pytest.raises(EvidenceError, match="no complete section header") as error_info:
        pcap.parse(header, where="x.pcapng")
    assert error_info.value.remedy


@given(st.integers(0, len(VALID) - 1), st.integers(1, 255))
def test_a_changed_byte_raises_only_evidence_error(offset: int, change: int) -> None:
    data = bytearray(VALID)
    data[offset] ^= change
    try:
        capture = pcap.parse(bytes(data), where="x")
    except EvidenceError:
        return
    n_before = sum(end <= offset for end in PACKET_ENDS)
    assert capture.packets.tcp_seq.tolist()[:n_before] == list(range(n_before))


@given(st.binary(max_size=400))
def test_arbitrary_bytes_after_a_section_raise_only_evidence_error(data: bytes) -> None:
    with suppress(EvidenceError):
        pcap.parse(section() + interface(1) + data, where="x")


@pytest.mark.parametrize("definition", [interface(), section() + interface()])
def test_a_file_with_too_many_definitions_is_rejected(definition: bytes) -> None:
    data = section() + definition * 400 + enhanced(_frame(1), ticks=1)
    assert pcap.parse(data, where="x").frames == 1
    with pytest.raises(EvidenceError, match="more than 1000 sections and interfaces"):
        pcap.parse(data + definition * 1000, where="x")


def test_a_packet_longer_than_any_snap_length_is_damage() -> None:
    frames = [Frame(T_NS, segment(1, size) + bytes(size), wire_bytes=1 << 20) for size in (262_104, 262_105)]
    for frame, damaged in zip(frames, (False, True), strict=True):
        capture = pcap.parse(section() + interface() + enhanced(frame, ticks=1), where="x")
        assert (capture.frames, capture.damage is not None) == (not damaged, damaged)


def test_an_option_with_an_invalid_size_is_ignored() -> None:
    options = option(9, b"\x03\x03") + option(14, b"\x01") + option(9, b"\x09")
    description = block(1, struct.pack("<HHI", 101, 0, 0) + options)
    assert pcap.parse(section() + description + enhanced(_frame(1), ticks=T_NS), where="x").packets.time_ns == [T_NS]


@given(st.lists(st.tuples(st.integers(0, 2**32 * 10**9 - 1), st.integers(0, 60), st.integers(0, 60)), max_size=12))
def test_both_formats_give_the_same_columns(records: list[tuple[int, int, int]]) -> None:
    frames = [
        Frame(time_ns, segment(index, size)[: 10 + captured], wire_bytes=140)
        for index, (time_ns, size, captured) in enumerate(records)
    ]
    for order in ("<", ">"):
        classic, pcapng = (make(frames, order=order) for make in (file_bytes, file_bytes_of))
        assert rows(pcap.parse(classic, where="x").packets) == rows(pcap.parse(pcapng, where="x").packets)


@pytest.mark.parametrize("name", ["nc-udp", "nc-tcp", "any"])
def test_a_recorded_capture_rewritten_by_scapy_as_pcapng_gives_the_same_columns(tmp_path: Path, name: str) -> None:
    path = TCPDUMP / f"{name}.pcap"
    with PcapReader(str(path)) as reader:
        link_type = reader.linktype
    writer = PcapNgWriter(str(tmp_path / "x.pcapng"))
    writer.linktype = link_type
    for frame in rdpcap(str(path)):
        writer.write(frame)
    writer.close()
    assert rows(pcap.read(tmp_path / "x.pcapng").packets) == rows(pcap.read(path).packets)


def test_frames_are_timed_in_the_order_of_the_file() -> None:
    frames = timed([segment(index, 0) for index in range(9)])
    assert pcap.parse(file_bytes_of(frames), where="x").packets.time_ns.tolist() == [
        frame.time_ns for frame in frames
    ]
