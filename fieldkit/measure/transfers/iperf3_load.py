"""Loss, rate, deliveries and jitter of an iperf3 load, computed from captures and independent of iperf3's report."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import NEGATIVE_LOSS_BOUNDS, Figure, Kind, Measured, Value, columns
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.headers import TCP, UDP
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES, Packets
from fieldkit.measure.transfers import delay, deliveries, stalls, tcp
from fieldkit.measure.transfers.clock_offset import Clocks
from fieldkit.measure.transfers.deliveries import FlowSchedule, StreamDeliveries
from fieldkit.measure.transfers.match import match
from fieldkit.measure.transfers.tcp_streams import Connections
from fieldkit.measure.transfers.udp import UdpPackets, datagrams

COLUMNS: Final = columns(
    100,
    (
        "iperf3_captured_bit_s",
        "bit/s",
        (
            "Payload rate of the test in the receiver's capture during the same seconds as iperf3_throughput_bit_s, "
            "counted from the first packet; each byte of a TCP stream counts once, each copy of a datagram counts. "
            "Compare it with iperf3_throughput_bit_s."
        ),
        Figure("iperf3 throughput, captured", Kind.MEDIAN, rank=65),
    ),
    (
        "iperf3_captured_loss",
        "share",
        (
            "1 - received/sent of the test in both captures. UDP: datagrams; compare it with iperf3_loss. TCP: "
            "payload bytes, including retransmissions. Empty if datagrams were fragmented."
        ),
        Figure("iperf3 loss, captured", Kind.MEAN, rank=66),
        NEGATIVE_LOSS_BOUNDS,
    ),
)

COOKIE_BYTES: Final = 37
"""Length of the cookie that is sent before the data of each TCP connection of a test (iperf_api.h, COOKIE_SIZE)."""


@dataclass(frozen=True)
class LoadFlow:
    """Data flow of a test from one robot to another.

    Attributes:
        protocol: Transport protocol.
        source_address: Address of the sender.
        destination_address: Address of the receiver.
        ports: Sender's and receiver's port of each stream.
        payload_bytes: Payload of a UDP datagram; shorter datagrams belong to the setup.
        window_s: Start and end of the time span over which the rate is computed, in seconds from the first packet.
    """

    protocol: Protocol
    source_address: str
    destination_address: str
    ports: tuple[tuple[int, int], ...]
    payload_bytes: int
    window_s: tuple[float, float]

    def streams(self, packets: Packets) -> list[Packets]:
        """Return the packets of each stream in a capture; for UDP, only the first fragments of data."""
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


def measure_totals(flow: LoadFlow, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return the columns of a test. `sender` or `receiver` is None if this capture is missing or damaged."""
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
    """Return the rate of received payload, in which each byte of a TCP stream is counted once.

    Copies of UDP datagrams are counted. Return None if no data has arrived, a packet has no time, the time span is
    empty, or the SYN of a TCP stream was not captured.
    """
    is_udp = flow.protocol is Protocol.UDP
    data = [packets if is_udp else packets.where(packets.tcp_payload_bytes > COOKIE_BYTES) for packets in received]
    times_ns: Ints = np.concatenate([packets.time_ns for packets in data]) if data else np.array([], dtype=np.int64)
    start_s, end_s = flow.window_s
    if not len(times_ns) or (times_ns == NO_TIME).any() or end_s <= start_s:
        return None
    start_ns, end_ns = (int(times_ns.min()) + round(1e9 * second) for second in flow.window_s)
    packets_in_window = [
        packets.where((start_ns <= packets.time_ns) & (packets.time_ns < end_ns)) for packets in data
    ]
    if is_udp:
        return 8 * flow.payload_bytes * sum(map(len, packets_in_window)) / (end_s - start_s)
    total = 0
    for stream, frames in zip(received, packets_in_window, strict=True):
        # A capture starts before the connections of its test, so it contains their SYNs.
        connections = Connections.from_syn(stream)
        if len(frames) and not len(connections.ports):
            return None
        total += connections.payload(frames).size_bytes
    return 8 * total / (end_s - start_s)


JITTER: Final = columns(
    stalls.RANK,
    (
        "iperf3_captured_jitter_mean_s",
        "s",
        (
            "Mean of the interarrival jitter after each datagram of the test (RFC 3550, section 6.4.1), from both "
            "captures; with several streams, the mean over the datagrams of all streams. Empty for TCP."
        ),
        Figure("iperf3 jitter, mean over the test (RFC 3550, captured)", Kind.MEDIAN, rank=63),
    ),
    (
        "iperf3_captured_variation_median_s",
        "s",
        "Median delay of the datagrams relative to the fastest one (RFC 5481), from both captures. Empty for TCP.",
    ),
    (
        "iperf3_captured_variation_p95_s",
        "s",
        "95th percentile of the datagrams' delay relative to the fastest datagram (RFC 5481). Empty for TCP.",
        Figure("iperf3 delay variation, 95 % (RFC 5481, captured)", Kind.MEDIAN, rank=63),
    ),
)
JITTER_CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="delay variation of iperf3's datagrams",
        columns=tuple(column.name for column in JITTER),
        source="both captures: times of sending and arrival of each datagram",
        against=("both captures: packets of the other direction, and the clock offset that fits all packets",),
        tolerance=(
            "an unknown clock drift of 0.1 ms per second; packets may be out of order by 0.1 s, because two "
            "processors capture them; no other source records the time of a single datagram"
        ),
        outcome=CheckOutcome.WITHHELD,
    ),
)


@dataclass(frozen=True)
class LoadStreams:
    """Streams of a load from one robot to another.

    Attributes:
        protocol: Transport protocol.
        source_address: Address of the sender.
        destination_address: Address of the receiver.
        port: Port that iperf3's server listens on.
        source_listens: True if the server is the sender.
        count: Number of streams.
        payload_bytes: Payload of a UDP datagram.
        ports: Sender's and receiver's port of each stream as reported by iperf3. If empty, they are determined from
            the packets.
        schedule: Known properties of each stream.
    """

    protocol: Protocol
    source_address: str
    destination_address: str
    port: int
    source_listens: bool
    count: int
    payload_bytes: int
    ports: tuple[tuple[int, int], ...]
    schedule: FlowSchedule

    def forward(self, packets: Packets) -> Packets:
        """Return the packets of the load's protocol from sender to receiver, with any ports."""
        return self._between(packets, self.source_address, self.destination_address)

    def backward(self, packets: Packets) -> Packets:
        """Return the packets of the load's protocol from receiver to sender, with any ports."""
        return self._between(packets, self.destination_address, self.source_address)

    def _between(self, packets: Packets, source: str, destination: str) -> Packets:
        number = UDP if self.protocol is Protocol.UDP else TCP
        return packets.where(packets.are_from(source) & packets.are_to(destination) & (packets.protocol == number))

    def stream_ports(self, sent: Packets) -> tuple[tuple[int, int], ...]:
        """Return the ports of each stream.

        Args:
            sent: Packets of the sender's capture, from `forward`. Unknown ports are determined from them.

        Raises:
            EvidenceError: More connections use the port than the load has streams.
        """
        if self.ports:
            return self.ports
        packets = sent.where(self._is_data(sent) if self.protocol is Protocol.UDP else sent.tcp_flags != 0)
        packets = packets.where((packets.sport if self.source_listens else packets.dport) == self.port)
        _, first = np.unique(packets.sport << 16 | packets.dport, return_index=True)
        first.sort()
        if self.protocol is Protocol.TCP:  # the first connection is iperf3's control connection
            first = first[1:]
        if len(first) > self.count:
            streams_text = format_count(self.count, "stream")
            raise EvidenceError(f"{len(first)} connections use the port of the load, but it has {streams_text}")
        return tuple((int(packets.sport[index]), int(packets.dport[index])) for index in first)

    def _is_data(self, packets: Packets) -> Mask:
        """Return a mask of the first fragments of data; datagrams of the setup are shorter."""
        mask: Mask = packets.udp_bytes == self.payload_bytes + UDP_HEADER_BYTES
        return mask

    def datagram_masks(self, first: Packets) -> Iterator[Mask]:
        """Yield a mask of the datagrams of each stream, given the first fragment of every datagram."""
        for sport, dport in self.stream_ports(first):
            yield self._is_data(first) & (first.sport == sport) & (first.dport == dport)


def measure_stalls(flow: str, load: LoadStreams, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return the columns of the stalls of a load.

    Args:
        flow: Prefix of the columns' names; see `stalls.declare_columns`.
        load: The load.
        sender: Packets of the sender's capture; None if it is missing or damaged.
        receiver: Packets of the receiver's capture; None if it is missing or damaged.
    """
    return stalls.measure(flow, lambda: read_deliveries(load, sender, receiver))


def read_deliveries(load: LoadStreams, sender: Packets | None, receiver: Packets | None) -> list[StreamDeliveries]:
    """Return the deliveries of each stream of a load. The arguments are the same as for `measure_stalls`.

    Raises:
        EvidenceError: The deliveries cannot be determined from the captures.
    """
    if sender is None or receiver is None:
        raise EvidenceError("there are no complete captures of both ends")
    _steady_clocks(load, sender, receiver)
    if load.protocol is Protocol.UDP:
        packets = _udp_packets(load, sender, receiver)
        masks = load.datagram_masks(packets.sent.where(packets.first))
        return [deliveries.udp_stream_deliveries(packets, mask, load.schedule) for mask in masks]
    sent, received, reverse = load.forward(sender), load.forward(receiver), load.backward(sender)
    return [
        deliveries.tcp_stream_deliveries(
            tcp.match_frames(
                *(
                    frames.where((frames.sport == source_port) & (frames.dport == destination_port))
                    for frames in (sent, received)
                )
            ),
            reverse.where((reverse.sport == destination_port) & (reverse.dport == source_port)),
            load.schedule,
        )
        for source_port, destination_port in load.stream_ports(sent)
    ]


def measure_jitter(load: LoadStreams, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return the columns of the jitter of a UDP load. The arguments are the same as for `measure_stalls`."""
    if load.protocol is not Protocol.UDP:
        return Measured.all_missing(JITTER, f"not applicable to {load.protocol}")
    if sender is None or receiver is None:
        return Measured.all_missing(JITTER, "there are no complete captures of both ends")
    try:
        streams = list(_transits_ns(load, sender, receiver))
    except EvidenceError as error:
        return Measured.all_missing(JITTER, error.what)
    values: dict[str, Value | None] = dict.fromkeys(column.name for column in JITTER)
    means_s = {
        index: mean_s
        for index, transit_ns in enumerate(streams)
        if (mean_s := delay.mean_jitter_s(transit_ns)) is not None
    }
    if means_s:
        counts = [len(streams[index]) - 1 for index in means_s]
        variation_s = np.concatenate([transit_ns - transit_ns.min() for transit_ns in streams]) / 1e9
        values = {
            "iperf3_captured_jitter_mean_s": float(np.average(list(means_s.values()), weights=counts)),
            "iperf3_captured_variation_median_s": float(np.median(variation_s)),
            "iperf3_captured_variation_p95_s": float(np.percentile(variation_s, 95)),
        }
    return Measured.from_optional(values, "too few datagrams of the test are in both captures")


def _udp_packets(load: LoadStreams, sender: Packets, receiver: Packets) -> UdpPackets:
    sent, received = load.forward(sender), load.forward(receiver)
    return UdpPackets(sent, received, match(sent, received), *datagrams(sent), load.port)


def _steady_clocks(load: LoadStreams, sender: Packets, receiver: Packets) -> Clocks | None:
    """Return the offset between the clocks, or None if a capture has no packet of one of the robots.

    Raises:
        EvidenceError: The offset cannot be estimated although both captures have packets of both robots: packets have
            no times or, otherwise, a clock was probably set during the load.
    """
    ends = load.source_address, load.destination_address
    clocks = delay.clocks_between(sender, receiver, *ends)
    has_packets = (packets.are_from(end).any() for packets in (sender, receiver) for end in ends)
    if clocks is None and all(has_packets):
        lacks_times = any((packets.time_ns == NO_TIME).any() for packets in (sender, receiver))
        raise EvidenceError("a capture lacks times" if lacks_times else delay.UNSTEADY)
    return clocks


def _transits_ns(load: LoadStreams, sender: Packets, receiver: Packets) -> Iterator[Ints]:
    """Yield an array for each stream with complete datagrams: their delays in ns, in the order of arrival.

    Raises:
        EvidenceError: The delays cannot be determined from the captures.
    """
    clocks = _steady_clocks(load, sender, receiver)
    if clocks is None:
        raise EvidenceError("no packet from receiver to sender is in both captures")
    matched = _udp_packets(load, sender, receiver)
    deliveries.require_times(matched.sent.time_ns, matched.received.time_ns)
    first, arrived_ns = matched.sent.where(matched.first), deliveries.arrivals_ns(matched)
    for mask in load.datagram_masks(first):
        if (np.append(mask, False)[matched.datagram] & matched.match.ambiguous).any():
            raise EvidenceError("packets of the flow cannot be distinguished, so their arrival times are unknown")
        is_complete = mask & (arrived_ns != NO_TIME)
        if is_complete.any():
            order = np.argsort(arrived_ns[is_complete], kind="stable")
            delay_s = clocks.delays_s(first.time_ns[is_complete][order], arrived_ns[is_complete][order])
            yield np.round(1e9 * delay_s).astype(np.int64)
