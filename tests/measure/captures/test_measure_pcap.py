import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import classic_pcap, pcap, pcapng
from fieldkit.measure.captures.headers import RAW_LINKS
from fieldkit.measure.captures.link_layers import LINKS
from tests.helpers.captures import TCPDUMP, file_bytes, segment, timed

LINK_TYPES = sorted(RAW_LINKS | LINKS.keys())


@pytest.mark.parametrize("link_type", LINK_TYPES)
def test_a_capture_without_packets_is_undamaged(link_type: int) -> None:
    capture = pcap.parse(file_bytes([], link_type=link_type), where="x")
    assert (capture.frames, capture.damage, len(capture.packets)) == (0, None, 0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty"),
        (b"#ROSBAG V2.0\n" + bytes(100), "not a pcap or pcapng file"),
        (file_bytes([])[:3], "not a pcap or pcapng file"),
        (file_bytes([])[:23], "ends inside its header"),
        (file_bytes([], link_type=147), "no link type that fieldkit can read: 147"),
    ],
)
def test_a_file_that_is_not_a_capture_is_rejected_with_a_remedy(data: bytes, message: str) -> None:
    with pytest.raises(EvidenceError, match=message) as error_info:
        pcap.parse(data, where="sender.pcap")
    assert error_info.value.remedy
    assert error_info.value.where == "sender.pcap"


def test_each_format_has_the_first_bytes_that_its_module_reads() -> None:
    by_module = {
        module: {magic for magic in pcap.FORMATS if pcap.FORMATS[magic] == module} for module in pcap.FORMATS.values()
    }
    assert by_module == {"classic_pcap": set(classic_pcap.MAGIC), "pcapng": {pcapng.MAGIC}}


def test_a_missing_capture_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="No such file"):
        pcap.read(tmp_path / "none.pcap")


FRAMES = timed([segment(index * 100, 100) for index in range(5)])
VALID = file_bytes(FRAMES)
RECORD = 16 + 40


def test_a_truncated_file_gives_the_packets_before_the_cut() -> None:
    for size in range(24, len(VALID)):
        capture = pcap.parse(VALID[:size], where="x")
        n_packets, n_remaining_bytes = divmod(size - 24, RECORD)
        assert capture.packets.tcp_seq.tolist() == [index * 100 for index in range(n_packets)]
        damage = f"ends inside the packet at byte {24 + n_packets * RECORD}, after packet {n_packets}"
        assert capture.damage == (damage if n_remaining_bytes else None)


@pytest.mark.parametrize(
    ("offset", "value"),
    [
        (4, b"\x00\xca\x9a\x3b"),  # 10^9 nanoseconds in a second
        (8, b"\x01\x00\x04\x00" * 2),  # 262,145 captured bytes
        (0, bytes(16)),  # zeros, as after a power cut
        (12, b"\x27\x00\x00\x00"),  # 39 bytes on the wire, but 40 captured bytes
    ],
)
def test_packets_before_a_broken_record_header_are_read_and_the_damage_is_reported(offset: int, value: bytes) -> None:
    start = 24 + 2 * RECORD
    data = VALID[: start + offset] + value + VALID[start + offset + len(value) :]
    capture = pcap.parse(data, where="x")
    assert capture.packets.tcp_seq.tolist() == [0, 100]
    assert capture.damage == f"no packet header at byte {start}, after packet 2"


@given(st.integers(24, len(VALID) - 1), st.integers(0, 7))
def test_a_flipped_bit_raises_no_error_and_does_not_change_earlier_packets(offset: int, bit: int) -> None:
    data = bytearray(VALID)
    data[offset] ^= 1 << bit
    capture = pcap.parse(bytes(data), where="x")
    before = (offset - 24) // RECORD
    assert capture.packets.tcp_seq.tolist()[:before] == [index * 100 for index in range(before)]


@given(st.binary(max_size=400))
def test_arbitrary_records_raise_no_error(data: bytes) -> None:
    for link_type in LINK_TYPES:
        pcap.parse(file_bytes([], link_type=link_type) + data, where="x")


def test_a_real_capture_of_the_papers_file_over_udp() -> None:
    # Field notes: 293,797 bytes through nc.traditional -u are 36 datagrams of at most 8,192 bytes in 215 fragments.
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
def test_sizes_and_times_equal_the_output_of_tcpdump(name: str) -> None:
    path = TCPDUMP / f"{name}.pcap"
    output_lines = subprocess.run(
        ["tcpdump", "-n", "-tt", "-v", "-r", str(path)], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    header_lines = [line for line in output_lines if "length" in line and line[0].isdigit()]
    packets = pcap.read(path).packets
    lengths = [int(line.rsplit("length ", 1)[1].rstrip(")")) for line in header_lines]
    assert lengths == (packets.wire_bytes - 14).tolist()
    stamps = [line.split()[0].replace(".", "") + "000" for line in header_lines]
    assert np.array(stamps).astype(np.int64).tolist() == packets.time_ns.tolist()


def _checksum(header: bytes) -> int:
    """Return the Internet checksum of RFC 1071, section 4.1. The checksum field of the header is 0."""
    total: int = sum(struct.unpack(f">{len(header) // 2}H", header))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


_FIELDS = st.tuples(
    st.integers(0, 255),  # type of service
    st.integers(100, 1500),  # total length
    st.integers(0, 0xFFFF),  # identification
    st.integers(0, 0x3FFF),  # flags and fragment offset
    st.integers(0, 255),  # time to live
    st.integers(0, 255),  # protocol
    st.binary(min_size=8, max_size=8),  # addresses
    st.integers(0, 10).flatmap(lambda words: st.binary(min_size=4 * words, max_size=4 * words)),  # options
)


@given(_FIELDS, st.data())
def test_any_changed_bit_of_an_ipv4_header_makes_its_checksum_wrong(
    fields: tuple[int, int, int, int, int, int, bytes, bytes], data: st.DataObject
) -> None:
    *numbers, addresses, options = fields
    words = 5 + len(options) // 4
    start = struct.pack(">BBHHHBB", 0x40 | words, *numbers)
    correct_checksum = _checksum(start + bytes(2) + addresses + options)
    header = bytearray(start + struct.pack(">H", correct_checksum) + addresses + options)
    # The first byte is excluded: the version and the header length determine which bytes the checksum covers.
    bit = data.draw(st.integers(8, 8 * len(header) - 1))
    changed = header.copy()
    changed[bit // 8] ^= 1 << bit % 8
    without_checksum = header[:10] + bytes(2) + header[12:]
    frames = timed([bytes(head) + bytes(20) for head in (header, changed, without_checksum)])
    packets = pcap.parse(file_bytes(frames, link_type=101), where="x").packets
    is_computed, is_decoded = any(changed[10:12]), int.from_bytes(changed[2:4]) >= len(header)
    expected = [False, *([is_computed] if is_decoded else []), False]
    assert packets.wrong_checksum.tolist() == expected
