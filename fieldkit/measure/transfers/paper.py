"""Figures computed as in the paper's procedure, for comparison with fieldkit's.

The paper's filters are tcpdump's `src SENDER and port P` at the sender and `dst RECEIVER and port P` at the receiver.
`port` matches either port of TCP, UDP or SCTP (pcap-filter(7)), so later fragments do not match.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import Mask
from fieldkit.measure.captures.packets import Packets

WINDOW_BYTES: Final[Mapping[Protocol, int]] = MappingProxyType({Protocol.TCP: 502, Protocol.UDP: 8192})
"""Ping payload that the paper uses as the window of each protocol."""

COUNTED: Final = ("paper_packets", "paper_received", "paper_loss", "paper_transfer_s")
"""Columns that depend on the counts of these filters, which may include packets of other transfers."""


def frames_from(packets: Packets, address: str, port: int) -> int:
    """Return the number of packets that match `src ADDRESS and port PORT`."""
    return int((packets.are_from(address) & _port(packets, port)).sum())


def frames_to(packets: Packets, address: str, port: int) -> int:
    """Return the number of packets that match `dst ADDRESS and port PORT`."""
    return int((packets.are_to(address) & _port(packets, port)).sum())


def transfer_s(packets: int, delay_s: float) -> float:
    """Return the paper's transfer time: one mean round trip of a ping with the window's payload per packet."""
    return packets * delay_s


def _port(packets: Packets, port: int) -> Mask:
    matches: Mask = (packets.sport == port) | (packets.dport == port)
    return matches
