"""Frames with radiotap headers, compared field by field with the dissector of scapy."""

import struct
from pathlib import Path

import pytest
from scapy.layers.dot11 import Dot11, Dot11Ack, Dot11QoS, RadioTap
from scapy.packet import Packet
from scapy.utils import PcapReader

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import pcap, radiotap
from fieldkit.measure.captures.radiotap import NO_SIGNAL, RETRY, UNKNOWN, RadioCapture, RadioFrames
from tests.helpers.captures import Frame, file_bytes
from tests.helpers.paths import DATA

A, B = "02:00:00:00:01:00", "02:00:00:00:02:00"
CAPTURES = sorted(DATA.glob("hwsim/*/*/*-monitor.pcap"))
QOS = Dot11(type=2, subtype=8, addr1=A, addr2=B, addr3=B, SC=0x1230)
PLAIN = bytes(QOS / Dot11QoS(TID=7))


def read(folder: Path, *frames: bytes) -> RadioCapture:
    path = folder / "a.pcap"
    path.write_bytes(file_bytes([Frame(1_000, frame) for frame in frames], link_type=127))
    return radiotap.read(path)


def read_one(folder: Path, frame: Packet | bytes) -> RadioFrames:
    frames = read(folder, bytes(frame)).frames
    assert len(frames) == 1
    return frames


def header(present: int, fields: bytes, *more_present: int) -> bytes:
    """Return a radiotap header with these words of presence bits and these bytes of fields."""
    words = struct.pack(f"<{1 + len(more_present)}I", present, *more_present)
    return struct.pack("<BBH", 0, 0, 4 + len(words) + len(fields)) + words + fields


def test_a_received_frame_has_signal_rate_and_addresses(tmp_path: Path) -> None:
    tap = RadioTap(
        present="TSFT+Flags+Rate+Channel+dBm_AntSignal+Antenna", mac_timestamp=9, Rate=12, dBm_AntSignal=-57
    )
    frame = read_one(tmp_path, tap / QOS / Dot11QoS(TID=7))
    assert not frame.is_sent[0]
    assert frame.is_data[0]
    assert frame.is_unicast[0]
    assert not frame.is_retry[0]
    assert (frame.signal_dbm[0], frame.rate_bit_s[0], frame.retries[0]) == (-57, 12_000_000, UNKNOWN)
    assert (frame.receiver[0], frame.transmitter[0]) == (int(A.replace(":", ""), 16), int(B.replace(":", ""), 16))
    assert frame.sequence[0] == 0x1230


@pytest.mark.parametrize(("tx_flags", "is_failed"), [(0, False), (1, True)])
def test_a_sent_frame_has_retries_and_no_signal(tmp_path: Path, tx_flags: int, *, is_failed: bool) -> None:
    # TX flags, data retries, MCS: mac80211 sends these fields (ieee80211_add_tx_radiotap_header).
    tap = header(1 << 15 | 1 << 17 | 1 << 19, struct.pack("<HBBBB", tx_flags, 3, 0x07, 0x00, 7))
    frame = read_one(tmp_path, tap + PLAIN)
    assert frame.is_sent[0]
    assert frame.is_failed[0] == is_failed
    assert (frame.signal_dbm[0], frame.rate_bit_s[0], frame.retries[0]) == (NO_SIGNAL, 65_000_000, 3)


@pytest.mark.parametrize(
    ("bit", "fields", "rate_bit_s"),
    [
        (19, (0x07, 0x00, 0), 6_500_000),
        (19, (0x07, 0x04, 7), 72_222_222),
        (19, (0x07, 0x01, 15), 270_000_000),
        (19, (0x02, 0x00, 7), 0),  # bandwidth and guard interval are not known
        (21, (0, 0, 0x00, 4, 0x91, 0, 0, 0, 0, 0, 0, 0), 390_000_000),
        (21, (0, 0, 0x04, 11, 0x92, 0, 0, 0, 0, 0, 0, 0), 1_733_333_333),
        (23, (0,) * 12, 0),  # 802.11ax
    ],
)
def test_rates_of_ht_and_vht(tmp_path: Path, bit: int, fields: tuple[int, ...], rate_bit_s: int) -> None:
    """The rates are those of IEEE 802.11-2020, tables 19-27 to 19-34 and 21-29 to 21-60."""
    assert read_one(tmp_path, header(1 << bit, bytes(fields)) + PLAIN).rate_bit_s[0] == rate_bit_s


def test_signals_of_single_antennas_follow_the_signal_of_the_frame(tmp_path: Path) -> None:
    antennas = (0xA0000820, 0x00000820)
    tap = header(1 << 5 | 0xA0000000, bytes((206, 200, 0, 201, 1)), *antennas)
    assert read_one(tmp_path, tap + PLAIN).signal_dbm[0] == -50


def test_fields_are_aligned_from_the_start_of_the_header(tmp_path: Path) -> None:
    tap = header(1 << 0 | 1 << 1 | 1 << 3 | 1 << 5, struct.pack("<IQBxHHb", 0, 9, 0, 2412, 0, -41), 0)
    tap = tap[:4] + struct.pack("<I", 1 << 0 | 1 << 1 | 1 << 3 | 1 << 5 | 1 << 31) + tap[8:]
    assert read_one(tmp_path, tap + PLAIN).signal_dbm[0] == -41


def test_flags_of_the_frame(tmp_path: Path) -> None:
    retried = Dot11(type=2, subtype=8, FCfield=RETRY, addr1="ff:ff:ff:ff:ff:ff", addr2=B, addr3=B)
    frame = read_one(tmp_path, RadioTap() / retried / Dot11QoS(A_MSDU_Present=1))
    assert frame.is_retry[0]
    assert frame.has_many_packets[0]
    assert not frame.is_unicast[0]
    null = read_one(tmp_path, RadioTap() / Dot11(type=2, subtype=12, addr1=A, addr2=B, addr3=B) / Dot11QoS())
    assert not null.is_data[0]
    acknowledgement = read_one(tmp_path, RadioTap() / Dot11(type=1, subtype=13, addr1=A) / Dot11Ack())
    assert (acknowledgement.transmitter[0], acknowledgement.sequence[0]) == (UNKNOWN, UNKNOWN)


def test_frames_with_a_wrong_checksum_or_a_malformed_header_are_omitted(tmp_path: Path) -> None:
    wrong_checksum = bytes(RadioTap(present="Flags", Flags="badFCS") / QOS)
    truncated = header(0, b"")[:6]
    too_long = struct.pack("<BBHI", 0, 0, 200, 0) + PLAIN
    other_version = b"\1" + header(0, b"")[1:] + PLAIN
    field_outside = header(1 << 5, b"") + PLAIN
    frames = read(tmp_path, wrong_checksum, truncated, too_long, other_version, field_outside).frames
    assert frames.signal_dbm.tolist() == [NO_SIGNAL]


def test_a_file_of_another_link_type_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(file_bytes([Frame(1, bytes(60))], link_type=1))
    with pytest.raises(EvidenceError, match="without radiotap"):
        radiotap.read(path)
    path.write_bytes(b"text")
    with pytest.raises(EvidenceError, match="not a pcap"):
        radiotap.read(path)


@pytest.mark.parametrize("path", CAPTURES, ids=lambda path: path.name)
def test_real_captures_have_the_fields_that_scapy_reads(path: Path) -> None:
    capture = radiotap.read(path)
    with PcapReader(str(path)) as reader:
        packets = list(reader)
    assert capture.damage is None
    assert len(capture.frames) == len(packets) == 174
    for row, packet in enumerate(packets):
        frame = capture.frames.where(slice(row, row + 1))
        tap = packet[RadioTap]
        assert frame.is_sent[0] == ("TXFlags" in tap.present)
        assert frame.signal_dbm[0] == (tap.dBm_AntSignal or NO_SIGNAL)
        if tap.Rate is not None:
            assert frame.rate_bit_s[0] == tap.Rate * 1e6
        else:
            assert tap.MCS_index is not None
            assert frame.rate_bit_s[0] > 0
        assert frame.sequence[0] == packet.SC
        assert frame.receiver[0] == int(packet.addr1.replace(":", ""), 16)
        assert frame.is_retry[0] == bool(packet.FCfield & "retry")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_packets_in_the_frames_of_a_mesh_are_those_of_the_radio_interface(role: str) -> None:
    folder = DATA / "hwsim/6.1.176/mesh-trial"
    monitor, radio = (pcap.read(folder / f"{role}{suffix}.pcap").packets for suffix in ("-monitor", ""))
    assert len(monitor) == len(radio) == 135
    for column in ("src", "dst", "protocol", "ip_id", "fragment_offset"):
        assert sorted(getattr(monitor, column).tolist()) == sorted(getattr(radio, column).tolist())
