"""The fields that scapy dissects from a capture file, in the columns of `Packets`; the reference for tests."""

from collections.abc import Sequence
from ipaddress import IPv4Address, IPv6Address
from pathlib import Path

from scapy.config import conf
from scapy.layers.inet import ICMP, IP, TCP, UDP
from scapy.layers.inet6 import IPv6, IPv6ExtHdrFragment, IPv46
from scapy.layers.l2 import CookedLinuxV2
from scapy.layers.sctp import SCTP
from scapy.packet import Packet
from scapy.utils import PcapReader, PcapWriter

from fieldkit.measure.captures.packets import Packets

# scapy only registers this link type number on other systems.
conf.l2types.register_num2layer(12, IPv46)

Row = tuple[int, ...]

_COMPUTED = {"content", "wrong_checksum"}


def write(path: Path, frames: Sequence[Packet], link_type: int, order: str = "<", *, nano: bool = True) -> None:
    writer = PcapWriter(str(path), linktype=link_type, endianness=order, nano=nano)
    for index, frame in enumerate(frames):
        frame.time = 1_700_000_000 + index * 0.25
        writer.write(frame)
    writer.close()


def dissected(path: Path) -> list[Row]:
    """The rows of all IP packets in a classic pcap file."""
    return [row for frame in PcapReader(str(path)) for row in _rows_of(frame)]


def rows(packets: Packets) -> list[Row]:
    """The rows of columns, with addresses as numbers; those that compute something from the packet are omitted."""
    columns = {name: getattr(packets, name) for name in Packets.__dataclass_fields__ if name not in _COMPUTED}
    for name in ("src", "dst"):
        columns[name] = [int(upper) << 64 | int(lower) for upper, lower in columns[name].tolist()]
    return [tuple(map(int, row)) for row in zip(*columns.values(), strict=True)]


def _rows_of(frame: Packet) -> list[Row]:
    if IP in frame:
        ip = frame[IP]
        addresses = [0xFFFF << 32 | int(IPv4Address(text)) for text in (ip.src, ip.dst)]
        ip_fields = (ip.proto, ip.id, ip.frag * 8, int("MF" in str(ip.flags)), ip.ihl * 4, ip.len - ip.ihl * 4)
        return [_row(frame, addresses, ip_fields, ip.payload)]
    if IPv6 in frame:
        ip = frame[IPv6]
        addresses = [int(IPv6Address(text)) for text in (ip.src, ip.dst)]
        protocol, identity, offset, more, payload_bytes, upper = ip.nh, 0, 0, 0, ip.plen, ip.payload
        while "ExtHdr" in type(upper).__name__ or type(upper).__name__ == "AH":
            payload_bytes -= len(bytes(upper)) - len(bytes(upper.payload))
            if isinstance(upper, IPv6ExtHdrFragment):
                identity, offset, more = upper.id, upper.offset * 8, upper.m
            protocol, upper = upper.nh, upper.payload
            if offset:
                break
        return [
            _row(
                frame,
                addresses,
                (protocol, identity, offset, more, 40 + ip.plen - payload_bytes, payload_bytes),
                upper,
            )
        ]
    return []


def _row(frame: Packet, addresses: Sequence[int], ip_fields: Row, upper: Packet) -> Row:
    _, _, offset, _, _, payload_bytes = ip_fields
    has_ports = isinstance(upper, TCP | UDP | SCTP) and offset == 0
    tcp = upper if has_ports and isinstance(upper, TCP) else None
    udp = upper if has_ports and isinstance(upper, UDP) else None
    icmp = upper if isinstance(upper, ICMP) and offset == 0 and upper.type in {0, 8} else None
    return (
        round(frame.time * 10**9),
        frame.wirelen or len(frame),
        *addresses,
        *ip_fields,
        upper.sport if has_ports else -1,
        upper.dport if has_ports else -1,
        tcp.seq if tcp else 0,
        tcp.ack if tcp else 0,
        int(tcp.flags) if tcp else 0,
        dict(tcp.options).get("Timestamp", (-1,))[0] if tcp else -1,
        dict(tcp.options).get("MSS", 0) if tcp and tcp.flags.S else 0,
        payload_bytes - tcp.dataofs * 4 if tcp else 0,
        udp.len if udp else 0,
        icmp.id + 65_536 * (icmp.type == 0) if icmp else -1,
        icmp.seq if icmp else -1,
        frame.ifindex if isinstance(frame, CookedLinuxV2) else -1,
    )
