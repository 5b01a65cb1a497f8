"""Columns of an iperf3 test from two captures, independent of iperf3's report."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import NEGATIVE_LOSS_BOUNDS, Figure, Kind, Measured, columns
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import NO_TIME, Ints
from fieldkit.measure.captures.ip import TCP, UDP
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES, Packets
from fieldkit.measure.transfers.load_streams import COOKIE_BYTES
from fieldkit.measure.transfers.streams import Connections

COLUMNS: Final = columns(
    100,
    (
        "iperf3_captured_bit_s",
        "bit/s",
        (
            "Payload of the test per second in the receiver's capture, each byte once, during the same seconds as "
            "iperf3_throughput_bit_s, counted from the first packet; compare the two."
        ),
        Figure("iperf3 throughput, captured", Kind.MEDIAN, rank=65),
    ),
    (
        "iperf3_captured_loss",
        "share",
        (
            "1 - received/sent of the test in both captures: for UDP datagrams, to be compared with iperf3_loss; for "
            "TCP payload bytes, retransmissions included. Empty if datagrams were fragmented."
        ),
        Figure("iperf3 loss, captured", Kind.MEAN, rank=66),
        NEGATIVE_LOSS_BOUNDS,
    ),
)


@dataclass(frozen=True)
class LoadFlow:
    """The data of one test from one robot to another.

    Attributes:
        protocol: Transport protocol.
        source_address: Address of the sender.
        destination_address: Address of the receiver.
        ports: Sender's and receiver's port of each stream.
        payload_bytes: Payload of a UDP datagram; shorter datagrams belong to the setup.
        window_s: Start and end of the time over which the rate is computed, in seconds from the first packet.
    """

    protocol: Protocol
    source_address: str
    destination_address: str
    ports: tuple[tuple[int, int], ...]
    payload_bytes: int
    window_s: tuple[float, float]

    def streams(self, packets: Packets) -> list[Packets]:
        """Return the data packets of each stream in a capture; of a UDP datagram only the first fragment."""
        number = UDP if self.protocol is Protocol.UDP else TCP
        ends = packets.are_from(self.source_address) & packets.are_to(self.destination_address)
        packets_between = packets.where(ends & (packets.protocol == number))
        streams = [
            packets_between.where((packets_between.sport == sport) & (packets_between.dport == dport))
            for sport, dport in self.ports
        ]
        if self.protocol is Protocol.UDP:
            return [stream.where(stream.udp_bytes == self.payload_bytes + UDP_HEADER_BYTES) for stream in streams]
        return streams


def measure(flow: LoadFlow, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return the columns of a test; a capture that is missing or damaged is None."""
    if sender is None or receiver is None:
        return Measured.all_missing(COLUMNS, "there are no complete captures of both ends")
    sent, received = flow.streams(sender), flow.streams(receiver)
    values = {"iperf3_captured_bit_s": _rate(flow, received), "iperf3_captured_loss": _loss(flow, sent, received)}
    return Measured.from_optional(values, "no packet of the test is in a capture, or its datagrams were fragmented")


def _loss(flow: LoadFlow, sent: list[Packets], received: list[Packets]) -> float | None:
    if flow.protocol is Protocol.UDP:
        if any(packets.more_fragments.any() for packets in sent):
            return None
        sent_amount, received_amount = (sum(map(len, streams)) for streams in (sent, received))
    else:
        sent_amount, received_amount = (
            sum(int(stream.tcp_payload_bytes.sum()) for stream in streams) for streams in (sent, received)
        )
    return 1 - received_amount / sent_amount if sent_amount else None


def _rate(flow: LoadFlow, received: list[Packets]) -> float | None:
    """Return the rate of received payload, each byte once; None if it cannot be computed."""
    udp = flow.protocol is Protocol.UDP
    data = [packets if udp else packets.where(packets.tcp_payload_bytes > COOKIE_BYTES) for packets in received]
    times_ns: Ints = np.concatenate([packets.time_ns for packets in data]) if data else np.array([], dtype=np.int64)
    start_s, end_s = flow.window_s
    if not len(times_ns) or (times_ns == NO_TIME).any() or end_s <= start_s:
        return None
    start_ns, end_ns = (int(times_ns.min()) + round(1e9 * second) for second in flow.window_s)
    inside = [packets.where((start_ns <= packets.time_ns) & (packets.time_ns < end_ns)) for packets in data]
    if udp:
        return 8 * flow.payload_bytes * sum(map(len, inside)) / (end_s - start_s)
    total = 0
    for stream, frames in zip(received, inside, strict=True):
        # A capture starts before the connections of its test, so it has their SYN.
        connections = Connections.from_syn(stream)
        if len(frames) and not len(connections.ports):
            return None
        total += connections.payload(frames).size_bytes
    return 8 * total / (end_s - start_s)
