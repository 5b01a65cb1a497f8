"""Captures for tests, built from bytes. The code under test is used only for the type of the result."""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address

from fieldkit.core.model import Protocol, Role
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers.transfer_spec import Transfer
from tests.helpers.paths import DATA

SENDER = "10.9.0.1"
RECEIVER = "10.9.0.2"
PORT = 1234
TCPDUMP = DATA / "tcpdump" / "4.99.3"


def transfer(protocol: Protocol) -> Transfer:
    ends = (Role.SENDER, Role.RECEIVER, SENDER, RECEIVER)
    return Transfer(protocol, *ends, PORT, "scan.bag", "recv.bag", captures=("sender.pcap", "receiver.pcap"))


@dataclass(frozen=True)
class Frame:
    """A captured frame with its time."""

    time_ns: int
    data: bytes
    wire_bytes: int | None = None


def file_bytes(frames: Iterable[Frame], *, order: str = "<", nano: bool = True, link_type: int = 101) -> bytes:
    magic, tick_ns = (0xA1B23C4D, 1) if nano else (0xA1B2C3D4, 1000)
    parts = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 128, link_type)]
    for frame in frames:
        seconds, remainder_ns = divmod(frame.time_ns, 1_000_000_000)
        wire_bytes = len(frame.data) if frame.wire_bytes is None else frame.wire_bytes
        parts += [
            struct.pack(f"{order}4I", seconds, remainder_ns // tick_ns, len(frame.data), wire_bytes),
            frame.data,
        ]
    return b"".join(parts)


def packets(frames: Iterable[Frame]) -> Packets:
    return pcap.parse(file_bytes(frames), where="test").packets


def ipv4(
    payload: bytes,
    *,
    protocol: int,
    size: int | None = None,
    ip_id: int = 0,
    offset: int = 0,
    more: bool = False,
    src: str = SENDER,
    dst: str = RECEIVER,
) -> bytes:
    """An IPv4 packet with `size` payload bytes on the wire, of which the capture contains `payload`."""
    total = 20 + (len(payload) if size is None else size)
    fragment = offset // 8 | (0x2000 if more else 0)
    source, destination = IPv4Address(src).packed, IPv4Address(dst).packed
    header = struct.pack(
        ">BBHHHBBH4s4s", 0x45, 0, total & 0xFFFF, ip_id, fragment, 64, protocol, 0, source, destination
    )
    return header + payload


def datagram(ip_id: int, payload_bytes: int, *, mtu: int = 1500, port: int = PORT, sport: int = 40000) -> list[bytes]:
    """The IP packets of a UDP datagram as Linux fragments it, first fragment first."""
    datagram_bytes = payload_bytes + 8
    fragment_bytes = (mtu - 20) // 8 * 8
    fragments: list[bytes] = []
    for offset in range(0, datagram_bytes, fragment_bytes):
        size = min(fragment_bytes, datagram_bytes - offset)
        header = struct.pack(">HHHH", sport, port, datagram_bytes, 0) if offset == 0 else b""
        fragments.append(
            ipv4(header, protocol=17, size=size, ip_id=ip_id, offset=offset, more=offset + size < datagram_bytes)
        )
    return fragments


def segment(
    seq: int,
    payload_bytes: int,
    *,
    flags: int = 0x10,
    sport: int = 40000,
    port: int = PORT,
    ip_id: int = 0,
    mss: int | None = None,
    ack: int = 0,
    back: bool = False,
) -> bytes:
    """A TCP segment without its payload; `back` is True if the receiver sends it."""
    options = b"" if mss is None else struct.pack(">BBBBHBB", 1, 1, 2, 4, mss, 1, 0)
    header_words = 5 + len(options) // 4
    ports, ends = ((port, sport), (RECEIVER, SENDER)) if back else ((sport, port), (SENDER, RECEIVER))
    header = (
        struct.pack(">HHIIBBHHH", *ports, seq % 2**32, ack % 2**32, header_words << 4, flags, 502, 0, 0) + options
    )
    return ipv4(header, protocol=6, size=len(header) + payload_bytes, ip_id=ip_id, src=ends[0], dst=ends[1])


def timed(
    data: Sequence[bytes], *, start_ns: int = 1_700_000_000_000_000_000, step_ns: int = 1_000_000
) -> list[Frame]:
    return [Frame(start_ns + index * step_ns, content, wire_bytes=65535 + 20) for index, content in enumerate(data)]
