"""All link types with IPv4 and IPv6, compared field by field with the dissector of scapy."""

import struct
from pathlib import Path

import pytest
from scapy.layers.dot11 import Dot11, Dot11Beacon, Dot11QoS, RadioTap
from scapy.layers.inet import ICMP, IP, TCP, UDP, fragment
from scapy.layers.inet6 import (
    ICMPv6EchoRequest,
    IPv6,
    IPv6ExtHdrDestOpt,
    IPv6ExtHdrFragment,
    IPv6ExtHdrHopByHop,
    IPv6ExtHdrRouting,
    PadN,
    fragment6,
)
from scapy.layers.ipsec import AH
from scapy.layers.l2 import ARP, LLC, SNAP, CookedLinux, CookedLinuxV2, Dot1AD, Dot1Q, Ether, Loopback
from scapy.layers.sctp import SCTP
from scapy.packet import Packet, Raw

from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.packets import NO_PORT, Packets
from tests.helpers.captures import RECEIVER, SENDER, Frame, file_bytes, ipv4, segment
from tests.helpers.dissected import dissected, rows, write

TO_DS, FROM_DS, MORE, RETRY, PROTECTED = 0x01, 0x02, 0x04, 0x08, 0x40
MAC = "02:00:00:00:00:01"
ETHER = Ether(src=MAC, dst="02:00:00:00:00:02")
ADDRESS_A, ADDRESS_B = "fd00::1", "2001:db8:1234:5678:9abc:def0:1234:5678"


def _dot11(flags: int, *, subtype: int = 0, qos: Packet | None = None) -> Packet:
    header = Dot11(type=2, subtype=subtype, FCfield=flags, addr1=MAC, addr2=MAC, addr3=MAC, addr4=MAC)
    return (header if qos is None else header / qos) / LLC(dsap=0xAA, ssap=0xAA, ctrl=3) / SNAP(OUI=0)


LINKS: dict[str, tuple[int, Packet | None]] = {
    "ethernet": (1, ETHER),
    "802.1Q": (1, ETHER / Dot1Q(vlan=7)),
    "802.1ad": (1, ETHER / Dot1AD(vlan=5) / Dot1Q(vlan=7)),
    "four tags": (1, ETHER / Dot1AD(vlan=5) / Dot1Q(vlan=7) / Dot1Q(vlan=8) / Dot1Q(vlan=9)),
    "cooked": (113, CookedLinux()),
    "cooked, tagged": (113, CookedLinux() / Dot1Q(vlan=7)),
    "cooked 2": (276, CookedLinuxV2()),
    "cooked 2, tagged": (276, CookedLinuxV2() / Dot1Q(vlan=7)),
    "raw 12": (12, None),
    "raw 101": (101, None),
    "802.11 to access point": (105, _dot11(TO_DS)),
    "802.11 from access point": (105, _dot11(FROM_DS | RETRY)),
    "802.11 between stations": (105, _dot11(0)),
    "802.11, four addresses": (105, _dot11(TO_DS | FROM_DS)),
    "802.11 QoS": (105, _dot11(FROM_DS, subtype=8, qos=Dot11QoS(TID=5))),
    "802.11 QoS, four addresses": (105, _dot11(TO_DS | FROM_DS, subtype=8, qos=Dot11QoS())),
    "radiotap": (127, RadioTap() / _dot11(TO_DS)),
    "radiotap QoS": (
        127,
        RadioTap(
            present="TSFT+Flags+Rate+Channel+dBm_AntSignal", mac_timestamp=9, Flags=0, Rate=12, dBm_AntSignal=-50
        )
        / _dot11(FROM_DS, subtype=8, qos=Dot11QoS()),
    ),
}


def _ipv4_packets() -> list[Packet]:
    forward, reverse = IP(src=SENDER, dst=RECEIVER), IP(src=RECEIVER, dst=SENDER)
    with_options = IP(src=SENDER, dst=RECEIVER, options=[b"\x94\x04\x00\x00"])
    large = IP(src=SENDER, dst=RECEIVER, id=65535) / UDP(sport=40000, dport=1234) / Raw(bytes(8192))
    # The last offsets need all 13 bits of the field.
    largest = IP(src=SENDER, dst=RECEIVER, id=1) / UDP(sport=40000, dport=1234) / Raw(bytes(65_507))
    return [
        IP(src=SENDER, dst=RECEIVER, id=7) / UDP(sport=4, dport=5) / Raw(bytes(20)),
        *fragment(largest, 8000),  # type: ignore[no-untyped-call]
        *fragment(large, 1480),  # type: ignore[no-untyped-call]
        forward / TCP(sport=1234, dport=40000, seq=2**32 - 1, flags="S", options=[("MSS", 1460), ("WScale", 7)]),
        reverse / TCP(sport=40000, dport=1234, seq=1, ack=2**32 - 1, flags="PA") / Raw(bytes(1448)),
        with_options / TCP(sport=1, dport=65535, ack=7, flags="FA") / Raw(b"abc"),
        forward / ICMP(id=0xFEDC) / Raw(bytes(56)),
        *fragment(reverse / ICMP(type="echo-reply", id=7) / Raw(bytes(3000)), 1480),  # type: ignore[no-untyped-call]
        reverse / ICMP(type="dest-unreach", code="port-unreachable") / forward / UDP(sport=4, dport=5),
    ]


def _ipv6_packets() -> list[Packet]:
    forward = IPv6(src=ADDRESS_A, dst=ADDRESS_B)
    hops = IPv6ExtHdrHopByHop(options=[PadN(optdata=bytes(10))])
    routing = IPv6ExtHdrRouting(addresses=[ADDRESS_B, ADDRESS_A])
    udp = UDP(sport=40000, dport=1234, chksum=1) / Raw(bytes(3000))
    fragmented = forward / hops / IPv6ExtHdrFragment(id=0xFEDC_BA98) / IPv6ExtHdrDestOpt() / udp
    return [
        forward / UDP(sport=4, dport=5) / Raw(bytes(20)),
        IPv6(src=ADDRESS_B, dst=ADDRESS_A) / TCP(sport=1, dport=2, seq=2**32 - 1, flags="FA") / Raw(bytes(1000)),
        forward / hops / routing / IPv6ExtHdrDestOpt() / TCP(sport=3, dport=4, seq=9) / Raw(b"abc"),
        *fragment6(fragmented, 1280),  # type: ignore[no-untyped-call]
        forward / IPv6ExtHdrFragment(id=5, m=0, offset=0) / SCTP(sport=8, dport=9),
        forward / ICMPv6EchoRequest(data=bytes(56)),
    ]


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nano", [False, True])
def test_every_column_equals_scapys_dissection(tmp_path: Path, name: str, order: str, nano: bool) -> None:
    link_type, link = LINKS[name]
    # IPv4 and IPv6 packets alternate: the rows of both versions must be in the order of the file.
    ipv4_packets, ipv6_packets = _ipv4_packets(), _ipv6_packets()
    alternating_packets = (
        [packet for pair in zip(ipv4_packets, ipv6_packets, strict=False) for packet in pair]
        + ipv4_packets[len(ipv6_packets) :]
        + ipv6_packets[len(ipv4_packets) :]
    )
    frames = [packet if link is None else link / packet for packet in alternating_packets]
    path = tmp_path / "x.pcap"
    write(path, frames, link_type, order, nano=nano)

    capture = pcap.read(path)

    assert rows(capture.packets) == dissected(path)
    assert len(capture.packets) == len(frames) > 20
    assert (capture.frames, capture.damage) == (len(frames), None)


@pytest.mark.parametrize(("link_type", "order"), [(0, "<"), (0, ">"), (108, ">")])
@pytest.mark.parametrize("family", [2, 10, 24, 28, 30])
def test_the_address_family_of_loopback_is_read_in_either_byte_order(link_type: int, order: str, family: int) -> None:
    packet = IPv6(src=ADDRESS_A, dst=ADDRESS_B) / UDP(sport=4, dport=5)
    data = file_bytes([Frame(0, struct.pack(f"{order}I", family) + bytes(packet))], link_type=link_type)
    assert pcap.parse(data, where="x").packets.dport.tolist() == [5]
    unknown_family = file_bytes([Frame(0, struct.pack(f"{order}I", 7) + bytes(packet))], link_type=link_type)
    capture = pcap.parse(unknown_family, where="x")
    assert (capture.frames, len(capture.packets)) == (1, 0)


def test_loopback_equals_scapys_dissection(tmp_path: Path) -> None:
    write(tmp_path / "x.pcap", [Loopback(type=2) / packet for packet in _ipv4_packets()], 0)
    assert rows(pcap.read(tmp_path / "x.pcap").packets) == dissected(tmp_path / "x.pcap")


PAYLOAD = IP(src=SENDER, dst=RECEIVER) / UDP(sport=4, dport=5) / Raw(b"abcd")


@pytest.mark.parametrize(
    ("link_type", "frame"),
    [
        (1, ETHER / ARP()),
        (1, ETHER / Dot1Q(vlan=7) / ARP()),
        (1, ETHER / Dot1Q(vlan=7, type=0x8100)),
        (113, CookedLinux(proto=0x0806) / ARP()),
        (105, Dot11(type=0, subtype=8, addr1=MAC, addr2=MAC, addr3=MAC) / Dot11Beacon()),
        (105, Dot11(type=1, subtype=13, addr1=MAC)),
        (105, Dot11(type=2, subtype=4, FCfield=TO_DS, addr1=MAC, addr2=MAC, addr3=MAC)),
        (105, _dot11(TO_DS | PROTECTED) / PAYLOAD),
        (105, _dot11(TO_DS, subtype=8, qos=Dot11QoS(A_MSDU_Present=1)) / PAYLOAD),
        (127, RadioTap(present="Flags", Flags="badFCS") / _dot11(TO_DS) / PAYLOAD),
    ],
)
def test_frames_without_a_readable_ip_packet_are_counted_as_others(
    tmp_path: Path, link_type: int, frame: Packet
) -> None:
    write(tmp_path / "x.pcap", [frame], link_type)
    capture = pcap.read(tmp_path / "x.pcap")
    assert (capture.frames, len(capture.packets)) == (1, 0)


def test_a_later_80211_fragment_is_not_an_ip_packet(tmp_path: Path) -> None:
    first_fragment, later_fragment = _dot11(TO_DS | MORE) / PAYLOAD, _dot11(TO_DS) / PAYLOAD
    later_fragment.SC = 1
    write(tmp_path / "x.pcap", [first_fragment, later_fragment], 105)
    capture = pcap.read(tmp_path / "x.pcap")
    assert capture.frames - len(capture.packets) == 1


def _radiotap(present: bytes, fields: bytes) -> bytes:
    return struct.pack("<BBH", 0, 0, 4 + len(present) + len(fields)) + present + fields


PLAIN = bytes.fromhex("0801 0000") + bytes(20)
SNAP_IPV4 = bytes.fromhex("aaaa03 000000 0800") + ipv4(struct.pack(">4H", 4, 5, 8, 0), protocol=17)
QOS_HT = bytes.fromhex("8881 0000") + bytes(20) + bytes(2) + bytes(4)


@pytest.mark.parametrize(
    ("frame", "count"),
    [
        (_radiotap(b"\x00\x00\x00\x00", b"") + PLAIN + SNAP_IPV4, 1),
        # The presence bitmap has two words, followed by the flags: a bad checksum.
        (_radiotap(b"\x02\x00\x00\x80\x00\x00\x00\x00", b"\x40") + PLAIN + SNAP_IPV4, 0),
        # After two words the time stamp is aligned to byte 16.
        (_radiotap(b"\x03\x00\x00\x80\x00\x00\x00\x00", bytes(4) + bytes(8) + b"\x40") + PLAIN + SNAP_IPV4, 0),
        (_radiotap(b"\x03\x00\x00\x80\x00\x00\x00\x00", bytes(4) + b"\x40" * 8 + b"\x00") + PLAIN + SNAP_IPV4, 1),
        # HT control adds four bytes.
        (_radiotap(b"\x00\x00\x00\x00", b"") + QOS_HT + SNAP_IPV4, 1),
        # The MAC header of 26 bytes is padded to 28.
        (_radiotap(b"\x02\x00\x00\x00", b"\x20") + b"\x88\x01" + bytes(26) + SNAP_IPV4, 1),
        (_radiotap(b"\x00\x00\x00\x00", b"") + b"\x88\x01" + bytes(26) + SNAP_IPV4, 0),
        (b"\x01" + _radiotap(b"\x00\x00\x00\x00", b"")[1:] + PLAIN + SNAP_IPV4, 0),
        # Bridge-tunnel encapsulation, and a protocol version other than 0.
        (_radiotap(b"\x00\x00\x00\x00", b"") + PLAIN + SNAP_IPV4[:3] + b"\x00\x00\xf8" + SNAP_IPV4[6:], 0),
        (_radiotap(b"\x00\x00\x00\x00", b"") + b"\x09" + PLAIN[1:] + SNAP_IPV4, 0),
    ],
)
def test_radio_headers_are_parsed_from_bytes(frame: bytes, count: int) -> None:
    packets = pcap.parse(file_bytes([Frame(0, frame)], link_type=127), where="x").packets
    assert packets.dport.tolist() == [5] * count


def _parse_frame(frame: bytes, *, link_type: int = 101, wire_bytes: int | None = None) -> Packets:
    return pcap.parse(file_bytes([Frame(0, frame, wire_bytes=wire_bytes)], link_type=link_type), where="x").packets


def test_payload_length_is_taken_from_the_ip_header() -> None:
    ethernet = bytes(12) + b"\x08\x00"
    assert _parse_frame(
        ethernet + segment(5, 1448), link_type=1, wire_bytes=14 + 1488
    ).tcp_payload_bytes.tolist() == [1448]
    short_frame = ethernet + ipv4(bytes(12), protocol=17, size=9) + bytes(20)
    assert _parse_frame(short_frame, link_type=1).ip_payload_bytes.tolist() == [9]


def test_padding_is_not_decoded_as_a_transport_header() -> None:
    packets = _parse_frame(
        bytes(12) + b"\x08\x00" + ipv4(b"\x04\xd2\x04\xd2", protocol=17) + b"\xff" * 22, link_type=1
    )
    assert (packets.dport.tolist(), packets.udp_bytes.tolist()) == ([1234], [0])


def test_the_length_of_a_superframe_above_64_kib_is_its_wire_length() -> None:
    huge = segment(5, 0)
    huge = huge[:2] + b"\x00\x00" + huge[4:]
    assert _parse_frame(huge, wire_bytes=40 + 100_000).tcp_payload_bytes.tolist() == [100_000]
    tagged = bytes(12) + b"\x81\x00\x00\x07\x08\x00" + huge
    assert _parse_frame(tagged, link_type=1, wire_bytes=18 + 40 + 100_000).tcp_payload_bytes.tolist() == [100_000]


@pytest.mark.parametrize(
    ("next_header", "extension", "wire_bytes", "payload"),
    [
        (0, b"\x06\x00\xc2\x04\x00\x01\x86\xbc", 40 + 100_028, 100_000),  # the jumbo option: 8 + 20 + 100,000 bytes
        (6, b"", 40 + 20 + 100_000, 100_000),
        (59, b"", 60, 0),  # no next header, only padding
    ],
)
def test_the_length_of_an_ipv6_superframe_is_its_jumbo_option_or_its_wire_length(
    next_header: int, extension: bytes, wire_bytes: int, payload: int
) -> None:
    header = struct.pack(">IHBB", 6 << 28, 0, next_header, 64) + bytes(32)
    packets = _parse_frame(header + extension + segment(5, 0)[20:], wire_bytes=wire_bytes)
    assert packets.tcp_payload_bytes.tolist() == [payload]
    assert packets.protocol.tolist() == [59 if next_header == 59 else 6]
    assert packets.ip_payload_bytes.tolist() == [0 if next_header == 59 else payload + 20]


def test_a_packet_truncated_in_its_headers_has_no_ports() -> None:
    packet = segment(5, 0)
    for length, count, has_ports in ((19, 0, 0), (20, 1, 0), (23, 1, 0), (24, 1, 1), (39, 1, 1)):
        packets = _parse_frame(packet[:length], wire_bytes=40)
        assert len(packets) == count
        assert (packets.dport != NO_PORT).sum() == has_ports
        assert not packets.tcp_seq.any()


def test_the_length_of_an_authentication_header_is_in_words() -> None:
    """The packet is built by hand, because scapy does not dissect the header after it."""
    authentication_header = AH(nh=17, payloadlen=4, spi=1, seq=1, icv=bytes(12))
    packets = _parse_frame(
        bytes(IPv6(src=ADDRESS_A, dst=ADDRESS_B) / authentication_header / UDP(sport=6, dport=7) / Raw(b"abcd"))
    )
    assert (packets.protocol.tolist(), packets.dport.tolist(), packets.udp_bytes.tolist()) == ([17], [7], [12])
    assert packets.ip_payload_bytes.tolist() == [12]


def test_an_ipv6_packet_truncated_in_its_extension_headers_has_no_ports() -> None:
    hops = IPv6ExtHdrHopByHop(options=[PadN(optdata=bytes(10))])
    packet = bytes(IPv6(src=ADDRESS_A, dst=ADDRESS_B) / hops / UDP(sport=4, dport=5))
    for length in range(len(packet)):
        packets = _parse_frame(packet[:length], wire_bytes=len(packet))
        assert len(packets) == (length >= 40)
        assert packets.protocol.tolist() == ([] if length < 40 else [17 if length >= 48 else 0])
        assert packets.dport.tolist() == ([] if length < 40 else [5 if length >= 60 else NO_PORT])


def test_headers_at_the_end_of_a_file_do_not_read_beyond_it() -> None:
    """A VLAN tag, a radio header or an extension may announce more bytes than the file has."""
    for link_type in (0, 1, 101, 105, 108, 113, 127, 276):
        for size in range(1, 60):
            for pattern in (b"\x00", b"\x81\x00", b"\x60", b"\x45", b"\xff", b"\x88\x01"):
                capture = pcap.parse(file_bytes([Frame(0, (pattern * 60)[:size])], link_type=link_type), where="x")
                assert capture.frames == 1
