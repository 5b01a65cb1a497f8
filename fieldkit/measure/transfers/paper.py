"""The figures as the paper's own procedure gives them, kept beside ours for comparison.

Its filters are tcpdump's `src SENDER and port P` at the sender and `dst RECEIVER and port P` at the receiver. `port`
matches either port of TCP, UDP or SCTP (pcap-filter(7)), so it sees first fragments only.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import Mask
from fieldkit.measure.captures.packets import Packets

WINDOW_BYTES: Final[Mapping[Protocol, int]] = MappingProxyType({Protocol.TCP: 502, Protocol.UDP: 8192})
"""Ping payload that the paper takes for the window of each protocol."""

COUNTED: Final = ("paper_packets", "paper_received", "paper_loss", "paper_transfer_s")
"""Columns of what its filters count, whoever's it is."""


def frames_from(packets: Packets, address: str, port: int) -> int:
    """Return how many packets match `src ADDRESS and port PORT`."""
    return int((packets.are_from(address) & _port(packets, port)).sum())


def frames_to(packets: Packets, address: str, port: int) -> int:
    """Return how many packets match `dst ADDRESS and port PORT`."""
    return int((packets.are_to(address) & _port(packets, port)).sum())


def transfer_s(packets: int, delay_s: float) -> float:
    """Return the paper's transfer time: each packet takes one mean round trip with a window of payload."""
    return packets * delay_s


def _port(packets: Packets, port: int) -> Mask:
    matches: Mask = (packets.sport == port) | (packets.dport == port)
    return matches
