"""Samples of a topic in a capture, by the head of each: magic, sequence number and time of sending.

The agent begins each sample with `std_msgs/UInt8MultiArray`'s empty layout and the length of its data, then the head
(`fieldkit.agent.stream`). A capture shows the head if it kept that part of the packet: always if a sample begins a
packet, not if TCP or a middleware put it behind another one.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.measure.captures import search
from fieldkit.measure.captures.arrays import Ints, Mask, Table
from fieldkit.measure.captures.ip import TCP
from fieldkit.measure.captures.packets import ACK, UDP_HEADER_BYTES, Packets
from fieldkit.measure.captures.search import Occurrences
from fieldkit.measure.transfers.datagrams import with_ports

MAGIC: Final = b"fieldkit"
HEAD_BYTES: Final = 24
_LAYOUT: Final = struct.Struct("<III")


@dataclass(frozen=True, eq=False)
class SampleHeads(Table):
    """Heads of samples in the order of a capture, also of those that were sent again.

    Attributes:
        sequence: Number of each sample.
        sent_ns: Time of sending in the sample, by the publisher's clock.
        at_ns: Time of capture of the packet.
        whole: Whether the packet holds the whole sample.
        end: Number of the TCP byte behind the sample, modulo 2**32; 0 over UDP.
        sport: Source port of the packet.
        dport: Destination port of the packet.
    """

    sequence: Ints
    sent_ns: Ints
    at_ns: Ints
    whole: Mask
    end: Ints
    sport: Ints
    dport: Ints

    def first(self) -> "SampleHeads":
        """Return the first head of each sample, in the order of sequence numbers."""
        _, index = np.unique(self.sequence, return_index=True)
        return self.where(index)


@dataclass(frozen=True, eq=False)
class SampleFlow:
    """A topic in one capture.

    Attributes:
        heads: Samples from publisher to subscriber whose head the capture shows.
        packets: All packets of its data from publisher to subscriber, with the ports of their first fragment.
        back: All packets of its data from subscriber to publisher, likewise.
    """

    heads: SampleHeads
    packets: Packets
    back: Packets

    @property
    def is_tcp(self) -> bool:
        """Whether the data go over TCP."""
        return bool((self.packets.protocol == TCP).any())

    def connection(self) -> tuple[Packets, Packets] | None:
        """Return the packets with payload of the TCP connection of the samples, and the answers.

        None if the samples are in several connections, or in none.
        """
        ports = np.unique(np.column_stack((self.heads.sport, self.heads.dport)), axis=0)
        if len(ports) != 1:
            return None
        ((sport, dport),) = ports.tolist()
        packets, back = self.packets, self.back
        data = packets.where((packets.sport == sport) & (packets.dport == dport) & (packets.tcp_payload_bytes > 0))
        return data, back.where((back.sport == dport) & (back.dport == sport) & (back.tcp_flags & ACK != 0))


def find(path: Path, size_bytes: int) -> Occurrences:
    """Return where a capture shows heads of samples with so many bytes of data; raises as `search.find`."""
    return search.find(path, _LAYOUT.pack(0, 0, size_bytes) + MAGIC)


def flow(
    packets: Packets,
    found: Occurrences,
    ports: frozenset[int],
    size_bytes: int,
    is_forward: Callable[[Packets], Mask],
) -> SampleFlow:
    """Return a topic in a capture.

    Args:
        packets: Of the capture.
        found: `find` in the same capture.
        ports: Ports of the topic's data.
        size_bytes: Data of a sample.
        is_forward: Which packets go from publisher to subscriber; the others go back.
    """
    known = with_ports(packets)
    data = np.isin(known.dport, list(ports)) | np.isin(known.sport, list(ports))
    forward = data & is_forward(packets)
    found = found.where(forward[found.packet])
    carrier = packets.where(found.packet)
    tcp_header_bytes = carrier.ip_payload_bytes - carrier.tcp_payload_bytes
    is_tcp = carrier.protocol == TCP
    begins = found.offset + _LAYOUT.size - np.where(is_tcp, tcp_header_bytes, UDP_HEADER_BYTES)
    ends = begins + size_bytes
    heads = SampleHeads(
        sequence=found.first,
        sent_ns=found.second,
        at_ns=carrier.time_ns,
        whole=np.where(is_tcp, carrier.tcp_payload_bytes, carrier.ip_payload_bytes - UDP_HEADER_BYTES) >= ends,
        end=np.where(is_tcp, (carrier.tcp_seq + ends) % (1 << 32), 0),
        sport=carrier.sport,
        dport=carrier.dport,
    )
    return SampleFlow(heads, known.where(forward), known.where(data & ~is_forward(packets)))
