"""Writes a pcap file per robot, with the headers of its IP packets.

A network in another process reports no IP packets. `PacketObserver` therefore creates them from the packets of
programs.
"""

import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import FileIO
from ipaddress import IPv4Address
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Final

from sim_backends.cosim.run_record import Window, WindowObserver
from sim_backends.network.ip import HEADER_BYTES, Fragment
from sim_backends.network.radio import IpLog
from sim_backends.network.tcp.connection import ConnectionName
from sim_backends.network.tcp.segments import Segment
from sim_backends.network.wire import IpPacket
from sim_backends.world.motion import State

_ICMP, _TCP, _UDP = 1, 6, 17
"""Numbers of the protocols in the IP header."""
_FIRST_HOST: Final = int(IPv4Address("10.0.0.1"))
"""Address of the first robot."""
_MULTICAST: Final = IPv4Address("239.255.0.1").packed
"""Destination of packets for all hosts: the multicast group of DDS discovery (OMG DDSI-RTPS 2.5, 9.6.2)."""
_TOPIC_PORT, _DISCOVERY_PORT = 7411, 7400
"""Ports of DDS: for user data of the first participant of a host, and for discovery (DDSI-RTPS 2.5, 9.6.2.3)."""
_FIRST_PORT: Final = 40_000
"""Destination port of the first flow; each further flow has the next port."""
_FIRST_EPHEMERAL_PORT: Final = 50_000
"""Source port of the first flow: a dynamic port (RFC 6335, section 6), not 49152, which tcpdump decodes specially."""
_PORTS: Final = 9_000
"""Number of ports that flows use before the first port is used again."""

_IP: Final = struct.Struct(">BBHHHBBH4s4s")
"""Version, service, size, id, fragment, time to live, protocol, checksum, source and destination (RFC 791)."""
_UDP_HEADER: Final = struct.Struct(">HHHH")
"""Source port, destination port, length and checksum (RFC 768)."""
_TCP_HEADER: Final = struct.Struct(">HHIIBBHHH")
"""Ports, sequence, acknowledgement, length, flags, window, checksum and urgent pointer (RFC 9293)."""
_ECHO_HEADER: Final = struct.Struct(">BBHHH")
"""Type, code, checksum, identifier and sequence number (RFC 792)."""
_SYN, _PUSH, _ACK = 0x02, 0x08, 0x10
"""Flags in the TCP header."""
_MORE_FRAGMENTS: Final = 0x2000
"""Flag of all fragments of a packet except the last one (RFC 791)."""
_WINDOW_SCALE: Final = 7
"""Linux's value for a receive buffer of 6 MiB."""
_MSS: Final = 1460
"""Maximum segment size: 1500 bytes of Ethernet without the headers of IP and TCP."""


@dataclass(frozen=True)
class CapturedFlow:
    """Headers of the packets of a flow that differ from the default ones.

    Attributes:
        port: Destination port; None for any free port.
        ping: Name of the ping if the packets are its ICMP echo requests or replies; empty for UDP and TCP.
        is_reply: True for replies of the ping.
    """

    port: int | None = None
    ping: str = ""
    is_reply: bool = False


_ECHO_REPLY, _ECHO_REQUEST = 0, 8
"""ICMP types (RFC 792)."""

_DEFAULT: Final = CapturedFlow()
NO_FLOWS: Final[Mapping[str, CapturedFlow]] = MappingProxyType({})


def assign_addresses(names: Sequence[str]) -> dict[str, IPv4Address]:
    """Return the addresses of robots in captures: the first is 10.0.0.1, each further robot has the next address.

    Args:
        names: The robots, in the order of their names.
    """
    return {name: IPv4Address(_FIRST_HOST + number) for number, name in enumerate(names)}


class IpEncoder:
    """Encodes fragments as the bytes of IP packets.

    Args:
        names: The hosts, in the order of `assign_addresses`.
        flows: Flows with special headers, by name.

    Attributes:
        addresses: Address of each host, by name.
    """

    def __init__(self, names: Sequence[str], flows: Mapping[str, CapturedFlow] = NO_FLOWS) -> None:
        self.addresses = assign_addresses(names)
        self._special_flows = flows
        self._packed: dict[str | None, bytes] = {name: address.packed for name, address in self.addresses.items()}
        self._packed[None] = _MULTICAST
        self._flows: dict[object, int] = {}

    def encode(self, fragment: Fragment, max_bytes: int) -> bytes:
        """Return the first bytes of an IP packet or fragment.

        Args:
            fragment: The fragment.
            max_bytes: Largest number of bytes.
        """
        packet = fragment.packet
        protocol, transport_header = self._transport(packet)
        begin = fragment.offset_bytes
        payload_part = transport_header[begin : begin + fragment.size_bytes - HEADER_BYTES]
        fragment_flag = _MORE_FRAGMENTS if fragment.index + 1 < fragment.count else 0
        header_fields = (
            0x45,  # version 4, header of 5 words
            0,  # type of service
            fragment.size_bytes,
            fragment.ip_id & 0xFFFF,
            fragment_flag | begin // 8,
            64,  # time to live
            protocol,
        )
        ends = self._packed[packet.source], self._packed[packet.destination]
        header = _IP.pack(*header_fields, _checksum(_IP.pack(*header_fields, 0, *ends)), *ends)
        data_bytes = min(fragment.size_bytes, max_bytes) - HEADER_BYTES - len(payload_part)
        return (header + payload_part + bytes(max(data_bytes, 0)))[:max_bytes]

    def _transport(self, packet: IpPacket) -> tuple[int, bytes]:
        """Return the number of the transport protocol, and the transport header."""
        length = packet.size_bytes - HEADER_BYTES
        flow = self._captured_flow(packet.identity[0])
        if flow.ping:
            kind = _ECHO_REPLY if flow.is_reply else _ECHO_REQUEST
            numbers = self._flow_number((flow.ping,)) + 1, (packet.identity[1] + 1) & 0xFFFF
            # The checksum of ICMP includes no pseudo header.
            checksum = _checksum(_ECHO_HEADER.pack(kind, 0, 0, *numbers))
            return _ICMP, _ECHO_HEADER.pack(kind, 0, checksum, *numbers)
        if isinstance(packet.body, tuple):
            name, segment = packet.body
            protocol, header = _TCP, self._tcp(packet, name, segment)
            checksum_offset = 16
        else:
            protocol, header = _UDP, _UDP_HEADER.pack(*self._udp_ports(packet), length, 0)
            checksum_offset = 6
        pseudo = self._packed[packet.source] + self._packed[packet.destination] + struct.pack(">HH", protocol, length)
        # The data is all zeros, which do not change the sum. A sum of 0 is sent as all ones (RFC 768), also for TCP.
        checksum = _checksum(pseudo + header) or 0xFFFF
        return protocol, header[:checksum_offset] + struct.pack(">H", checksum) + header[checksum_offset + 2 :]

    def _captured_flow(self, name: object) -> CapturedFlow:
        return self._special_flows.get(name, _DEFAULT) if isinstance(name, str) else _DEFAULT

    def _flow_number(self, flow: object) -> int:
        return self._flows.setdefault(flow, len(self._flows)) % _PORTS

    def _udp_ports(self, packet: IpPacket) -> tuple[int, int]:
        """Return the source port and the destination port of a packet."""
        if packet.transport == "topic":
            return _TOPIC_PORT, _DISCOVERY_PORT if packet.destination is None else _TOPIC_PORT
        # Only the identity of a UDP packet contains the name of a flow; other transports number their packets.
        ends = packet.transport, packet.source, packet.destination
        name = packet.identity[0] if packet.transport == "udp" else ends
        number = self._flow_number(name)
        return _FIRST_EPHEMERAL_PORT + number, self._captured_flow(name).port or _FIRST_PORT + number

    def _tcp(self, packet: IpPacket, name: ConnectionName, segment: Segment) -> bytes:
        """Return the TCP header of a segment, with its options and without a checksum."""
        number = self._flow_number(name)
        ports = _FIRST_EPHEMERAL_PORT + number, self._captured_flow(name.flow).port or _FIRST_PORT + number
        options = _syn_options(segment) if segment.syn else _options(segment)
        flags = (_SYN if segment.syn else 0) | (_PUSH if segment.length else 0)
        flags |= 0 if segment.acknowledges is None else _ACK
        # The window of a SYN is not scaled (RFC 7323, section 2.2).
        window = segment.window_bytes >> (0 if segment.syn else _WINDOW_SCALE)
        return (
            _TCP_HEADER.pack(
                *(ports if packet.source == name.source else ports[::-1]),
                segment.first & 0xFFFFFFFF,
                (segment.acknowledges or 0) & 0xFFFFFFFF,
                (20 + len(options)) // 4 << 4,  # length of the header in words, in the upper four bits
                flags,
                min(window, 0xFFFF),
                0,  # checksum, which the caller inserts
                0,  # urgent pointer
            )
            + options
        )


def _timestamps(segment: Segment) -> bytes:
    """Return the timestamps option (RFC 7323): kind 8, length 10, and two times in milliseconds."""
    return struct.pack(">BBII", 8, 10, _ms(segment.sent_ns), _ms(segment.echoes_ns or 0))


def _ms(at_ns: int) -> int:
    return at_ns // 1_000_000 & 0xFFFFFFFF


def _syn_options(segment: Segment) -> bytes:
    """Return the options MSS, SACK permitted, timestamps and window scale, in the order of Linux."""
    return struct.pack(">BBHBB", 2, 4, _MSS, 4, 2) + _timestamps(segment) + bytes((1, 3, 3, _WINDOW_SCALE))


def _options(segment: Segment) -> bytes:
    """Return the options of a segment without SYN: timestamps, and SACK blocks (kind 5) if there are any.

    Before each option are two bytes of padding (kind 1), as Linux sends them.
    """
    options = b"\1\1" + _timestamps(segment)
    if segment.sacks:
        blocks = [edge & 0xFFFFFFFF for block in segment.sacks for edge in block]
        options += struct.pack(f">BBBB{len(blocks)}I", 1, 1, 5, 2 + 4 * len(blocks), *blocks)
    return options


def _checksum(data: bytes) -> int:
    """Return the internet checksum (RFC 1071) of an even number of bytes in which the checksum field is 0."""
    total: int = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


_NANOSECONDS_MAGIC: Final = 0xA1B23C4D
"""First number of a pcap file whose time stamps have nanoseconds."""
_LINKTYPE_RAW: Final = 101
"""Packets begin with the IP header."""
_FILE_HEADER: Final = struct.Struct("<IHHiIII")
"""First number, version (2 numbers), 2 unused numbers, largest stored packet, link type."""
_RECORD_HEADER: Final = struct.Struct("<IIII")
"""Seconds, nanoseconds, stored bytes and original bytes of a packet."""


class Captures:
    """Writes the packets of each robot to a pcap file; robots without packets have no file.

    Files grow by whole packets, so they are readable even if the run is killed.

    Args:
        folder: Folder of the files; it is created for the first packet.
        names: The robots.
        snap_bytes: Number of bytes of each packet that are stored, like tcpdump's `-s`.
        flows: Flows with special headers, by name.
    """

    def __init__(
        self, folder: Path, names: Sequence[str], snap_bytes: int, flows: Mapping[str, CapturedFlow] = NO_FLOWS
    ) -> None:
        self._folder = folder
        self._snap_bytes = snap_bytes
        self._encoder = IpEncoder(names, flows)
        self._pending_data: dict[str, bytearray] = {}
        self._files: dict[str, FileIO] = {}
        self._written_bytes: dict[str, int] = {}

    def log(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Add an IP packet or fragment that a robot sent or that arrived at it (`IpLog`)."""
        data = self._encoder.encode(fragment, self._snap_bytes)
        if name not in self._pending_data:
            self._pending_data[name] = bytearray(
                _FILE_HEADER.pack(_NANOSECONDS_MAGIC, 2, 4, 0, 0, self._snap_bytes, _LINKTYPE_RAW)
            )
        self._pending_data[name] += _RECORD_HEADER.pack(*divmod(at_ns, 10**9), len(data), fragment.size_bytes) + data

    def flush(self) -> None:
        """Write the packets that are not written yet.

        Raises:
            OSError: A file cannot be written.
        """
        for name, pending_data in self._pending_data.items():
            if name not in self._files:
                self._folder.mkdir(exist_ok=True)
                self._written_bytes[name] = 0
                self._files[name] = (self._folder / f"{name}.pcap").open("xb", buffering=0)
            self._write(name, pending_data)

    def close(self) -> None:
        """Close the files; packets that were not flushed are lost."""
        for file in self._files.values():
            file.close()

    def _write(self, name: str, pending_data: bytearray) -> None:
        descriptor, at, written_bytes = self._files[name].fileno(), self._written_bytes[name], 0
        while written_bytes < len(pending_data):
            # The position is explicit, so that an interrupt before the count is updated does not duplicate data.
            written_bytes += os.pwrite(descriptor, bytes(pending_data[written_bytes:]), at + written_bytes)
        self._written_bytes[name], self._pending_data[name] = at + written_bytes, bytearray()


def packets_between(capture: bytes, begin_ns: int, end_ns: int) -> bytes:
    """Return a copy of a capture that contains only the packets of an interval of simulated time.

    Args:
        capture: The content of the file.
        begin_ns: Start of the interval.
        end_ns: End of the interval, exclusive.
    """
    records = (capture[begin:end] for at_ns, begin, end in _records(capture) if begin_ns <= at_ns < end_ns)
    return capture[: _FILE_HEADER.size] + b"".join(records)


def _records(capture: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the time of each packet in nanoseconds, and the range of its record in the file."""
    begin = _FILE_HEADER.size
    while begin < len(capture):
        seconds, nanoseconds, captured_bytes, _ = _RECORD_HEADER.unpack_from(capture, begin)
        end = begin + _RECORD_HEADER.size + captured_bytes
        yield seconds * 10**9 + nanoseconds, begin, end
        begin = end


def first_tcp_packet_ns(capture: bytes, port: int) -> int | None:
    """Return the time of the first TCP packet to a port in a capture; None if there is no such packet.

    Args:
        capture: The content of the file.
        port: Destination port.
    """
    for at_ns, begin, end in _records(capture):
        packet = capture[begin + _RECORD_HEADER.size : end]
        # Byte 9 of the IP header is the protocol; bytes 2 and 3 of the TCP header are the destination port.
        if packet[9] == _TCP and packet[HEADER_BYTES + 2 : HEADER_BYTES + 4] == port.to_bytes(2, "big"):
            return at_ns
    return None


class PacketObserver:
    """An observer that passes the packets of programs to the log of IP packets, and all calls to a recorder.

    Each packet of a program is logged as one IP packet without fragments: as an ICMP echo if its flow is a ping,
    otherwise as a UDP datagram, also if its transport is not UDP. It is logged at its source when it enters the
    network, and at its destination when it arrives.

    Args:
        recorder: The recorder, which accepts IP packets.
        log: The method `log_ip` of the recorder.
    """

    def __init__(self, recorder: WindowObserver, log: IpLog) -> None:
        self._recorder = recorder
        self._log = log

    def begin(self, states: Mapping[str, State]) -> None:
        """Implement `WindowObserver.begin`."""
        self._recorder.begin(states)

    def window(self, window: Window) -> None:
        """Log the packets of a window in order of time, and forward the window to the recorder."""
        events = [(fate.packet.enters_ns, fate.packet.source, fate.packet) for fate in window.entered_fates]
        events += [
            (fate.arrived_ns, fate.packet.destination, fate.packet)
            for fate in window.decided_fates
            if fate.arrived_ns is not None
        ]
        for at_ns, name, packet in sorted(events, key=itemgetter(0)):
            size_bytes = HEADER_BYTES + _UDP_HEADER.size + packet.size_bytes
            datagram = IpPacket(packet.source, packet.destination, "udp", size_bytes, packet.identity, None)
            self._log(at_ns, name, Fragment(datagram, packet.packet_id, 0, 1, 0, size_bytes))
        self._recorder.window(window)
