"""Figures of an iperf3 test by two captures: the independent witness of its own."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import OVERCOUNTED, Figure, Kind, Measured, columns
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import NO_TIME, Ints
from fieldkit.measure.captures.ip import TCP, UDP
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES, Packets
from fieldkit.measure.transfers.streams import Connections

COLUMNS: Final = columns(
    100,
    (
        "iperf3_captured_bit_s",
        "bit/s",
        (
            "Payload of the test per second in the receiver's capture, each byte once, in the seconds of "
            "iperf3_throughput_bit_s, with which it is to be compared, from the first packet on."
        ),
        Figure("iperf3 throughput, captured", Kind.MEDIAN, rank=65),
    ),
    (
        "iperf3_captured_loss",
        "share",
        (
            "1 - received/sent of the test in both captures: UDP datagrams, to be compared with iperf3_loss; of TCP "
            "payload bytes, those sent again too. Empty where datagrams were fragmented."
        ),
        Figure("iperf3 loss, captured", Kind.MEAN, rank=66),
        OVERCOUNTED,
    ),
)

_COOKIE_BYTES: Final = 37
"""With which each TCP connection of a test begins, long before its data (iperf_api.h, COOKIE_SIZE)."""


@dataclass(frozen=True)
class LoadFlow:
    """The data of one test on the way from one robot to another.

    Attributes:
        protocol: Transport protocol.
        source_address: Address of who sends.
        destination_address: Address of who receives.
        ports: Ports of each stream, the sender's and the receiver's.
        payload_bytes: Payload of a UDP datagram, by which greetings are told apart.
        window_s: From when on, and until when, its rate is taken, in seconds from the first packet on.
    """

    protocol: Protocol
    source_address: str
    destination_address: str
    ports: tuple[tuple[int, int], ...]
    payload_bytes: int
    window_s: tuple[float, float]

    def streams(self, packets: Packets) -> list[Packets]:
        """Return the data packets of each stream in a capture; of a UDP datagram its first fragment."""
        number = UDP if self.protocol is Protocol.UDP else TCP
        ends = packets.are_from(self.source_address) & packets.are_to(self.destination_address)
        own = packets.where(ends & (packets.protocol == number))
        found = [own.where((own.sport == sport) & (own.dport == dport)) for sport, dport in self.ports]
        if self.protocol is Protocol.UDP:
            return [one.where(one.udp_bytes == self.payload_bytes + UDP_HEADER_BYTES) for one in found]
        return found


def measure(flow: LoadFlow, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return the columns of a test; None for a capture that is not at hand, or not whole."""
    if sender is None or receiver is None:
        return Measured.nothing(COLUMNS, "there are no whole captures of both ends")
    left, came = flow.streams(sender), flow.streams(receiver)
    values = {"iperf3_captured_bit_s": _rate(flow, came), "iperf3_captured_loss": _loss(flow, left, came)}
    return Measured.of(values, "no packet of the test is in a capture, or its datagrams were fragmented")


def _loss(flow: LoadFlow, left: list[Packets], came: list[Packets]) -> float | None:
    if flow.protocol is Protocol.UDP:
        if any(packets.more_fragments.any() for packets in left):
            return None
        sent, received = (sum(map(len, streams)) for streams in (left, came))
    else:
        sent, received = (sum(int(stream.tcp_payload_bytes.sum()) for stream in streams) for streams in (left, came))
    return 1 - received / sent if sent else None


def _rate(flow: LoadFlow, came: list[Packets]) -> float | None:
    """Return the rate at which payload came, each byte once; None where nothing tells it."""
    udp = flow.protocol is Protocol.UDP
    data = [packets if udp else packets.where(packets.tcp_payload_bytes > _COOKIE_BYTES) for packets in came]
    times_ns: Ints = np.concatenate([packets.time_ns for packets in data]) if data else np.array([], dtype=np.int64)
    start_s, end_s = flow.window_s
    if not len(times_ns) or (times_ns == NO_TIME).any() or end_s <= start_s:
        return None
    start_ns, end_ns = (int(times_ns.min()) + round(1e9 * second) for second in flow.window_s)
    inside = [packets.where((start_ns <= packets.time_ns) & (packets.time_ns < end_ns)) for packets in data]
    if udp:
        return 8 * flow.payload_bytes * sum(map(len, inside)) / (end_s - start_s)
    total = 0
    for stream, frames in zip(came, inside, strict=True):
        # A capture begins before the connections that it is for, so it has their SYN.
        begun = Connections.begun(stream)
        if len(frames) and not len(begun.ports):
            return None
        total += begun.payload(frames).size_bytes
    return 8 * total / (end_s - start_s)
