"""Streams of an iperf3 load in two captures: their deliveries, and the jitter of datagrams over the whole test."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.ip import TCP, UDP
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES, Packets
from fieldkit.measure.transfers import delay, deliveries, stalls, tcp
from fieldkit.measure.transfers.clocks import Clocks
from fieldkit.measure.transfers.datagrams import datagrams
from fieldkit.measure.transfers.deliveries import Delivery, FlowSchedule
from fieldkit.measure.transfers.match import match
from fieldkit.measure.transfers.udp import UdpPackets

COOKIE_BYTES: Final = 37
"""With which a client begins each TCP connection of a test, before its data (iperf_api.h, COOKIE_SIZE)."""

JITTER: Final = columns(
    stalls.RANK,
    (
        "iperf3_captured_jitter_mean_s",
        "s",
        (
            "Mean over the whole test of the interarrival jitter after each datagram (RFC 3550, section 6.4.1), by "
            "both captures; of several streams over all of their datagrams. Empty for TCP."
        ),
        Figure("iperf3 jitter, mean over the test (RFC 3550, captured)", Kind.MEDIAN, rank=63),
    ),
    (
        "iperf3_captured_variation_median_s",
        "s",
        "Median of the datagrams' delay less that of the fastest (RFC 5481), by both captures. Empty for TCP.",
    ),
    (
        "iperf3_captured_variation_p95_s",
        "s",
        "95th percentile of that.",
        Figure("iperf3 delay variation, 95 % (RFC 5481, captured)", Kind.MEDIAN, rank=63),
    ),
)
JITTER_CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="variation of the delay of iperf3's datagrams",
        columns=tuple(column.name for column in JITTER),
        source="both captures: when each datagram left and arrived",
        against=("both captures: packets of the other direction, and the clock that fits all",),
        tolerance="two quartz clocks may drift by 0.1 ms a second against each other",
        outcome=CheckOutcome.WITHHELD,
    ),
)


@dataclass(frozen=True)
class LoadStreams:
    """The data of one load on its way from one robot to another.

    Attributes:
        protocol: Transport protocol.
        source_address: Address of the robot that sends.
        destination_address: Address of the one that receives.
        port: Port that iperf3's server listens on.
        source_listens: Whether that is the robot that sends.
        count: How many streams there are.
        payload_bytes: Payload of a UDP datagram.
        ports: Ports of each stream, the sender's and the receiver's, as iperf3 says; empty to look for them.
        expected: What is known of each stream.
    """

    protocol: Protocol
    source_address: str
    destination_address: str
    port: int
    source_listens: bool
    count: int
    payload_bytes: int
    ports: tuple[tuple[int, int], ...]
    expected: FlowSchedule

    def forward(self, packets: Packets) -> Packets:
        """Return the packets of its protocol on its way, whatever their ports."""
        return self._on_way(packets, self.source_address, self.destination_address)

    def backward(self, packets: Packets) -> Packets:
        """Return those the other way."""
        return self._on_way(packets, self.destination_address, self.source_address)

    def _on_way(self, packets: Packets, source: str, destination: str) -> Packets:
        number = UDP if self.protocol is Protocol.UDP else TCP
        return packets.where(packets.are_from(source) & packets.are_to(destination) & (packets.protocol == number))

    def found_ports(self, sent: Packets) -> tuple[tuple[int, int], ...]:
        """Return the ports of each stream among packets of `forward` in the sender's capture.

        Raises:
            EvidenceError: They cannot be distinguished from those of other connections.
        """
        if self.ports:
            return self.ports
        own = sent.where(self._data(sent) if self.protocol is Protocol.UDP else sent.tcp_flags != 0)
        own = own.where((own.sport if self.source_listens else own.dport) == self.port)
        _, first = np.unique(own.sport << 16 | own.dport, return_index=True)
        first.sort()
        if self.protocol is Protocol.TCP:  # its first connection is for control
            first = first[1:]
        if len(first) > self.count:
            raise EvidenceError(f"{len(first)} connections have its port, and it has {self.count}")
        return tuple((int(own.sport[index]), int(own.dport[index])) for index in first)

    def _data(self, packets: Packets) -> Mask:
        """Return which packets are first fragments of its datagrams: greetings are shorter."""
        data: Mask = packets.udp_bytes == self.payload_bytes + UDP_HEADER_BYTES
        return data

    def chosen(self, first: Packets) -> Iterator[Mask]:
        """Yield for each stream which of its datagrams these first fragments begin."""
        for sport, dport in self.found_ports(first):
            yield self._data(first) & (first.sport == sport) & (first.dport == dport)


def measure(flow: str, load: LoadStreams, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return the columns of the stalls of a load; None for a capture that is not at hand, or not whole.

    Args:
        flow: What they begin with, as for `stalls.declared`.
        load: The load.
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's.
    """
    return stalls.measure(flow, lambda: read(load, sender, receiver))


def read(load: LoadStreams, sender: Packets | None, receiver: Packets | None) -> list[Delivery]:
    """Return the deliveries of each stream of a load; arguments as of `measure`.

    Raises:
        EvidenceError: The captures do not show them.
    """
    if sender is None or receiver is None:
        raise EvidenceError("there are no whole captures of both ends")
    _demand_steady(load, sender, receiver)
    if load.protocol is Protocol.UDP:
        crossing = _crossing(load, sender, receiver)
        chosen = load.chosen(crossing.sent.where(crossing.first))
        return [deliveries.of_udp(crossing, mine, load.expected) for mine in chosen]
    sent, received, back = load.forward(sender), load.forward(receiver), load.backward(sender)
    return [
        deliveries.of_tcp(
            tcp.beside(
                *(frames.where((frames.sport == own) & (frames.dport == other)) for frames in (sent, received))
            ),
            back.where((back.sport == other) & (back.dport == own)),
            load.expected,
        )
        for own, other in load.found_ports(sent)
    ]


def measure_jitter(load: LoadStreams, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return the columns of the jitter of a UDP load; arguments as of `measure`."""
    if load.protocol is not Protocol.UDP:
        return Measured.nothing(JITTER, f"{load.protocol} has none")
    if sender is None or receiver is None:
        return Measured.nothing(JITTER, "there are no whole captures of both ends")
    try:
        streams = list(_transits_ns(load, sender, receiver))
    except EvidenceError as error:
        return Measured.nothing(JITTER, error.what)
    values: dict[str, Value | None] = dict.fromkeys(column.name for column in JITTER)
    means_s = {
        index: mean_s
        for index, transit_ns in enumerate(streams)
        if (mean_s := delay.mean_jitter_s(transit_ns)) is not None
    }
    if means_s:
        counts = [len(streams[index]) - 1 for index in means_s]
        over_s = np.concatenate([transit_ns - transit_ns.min() for transit_ns in streams]) / 1e9
        values = {
            "iperf3_captured_jitter_mean_s": float(np.average(list(means_s.values()), weights=counts)),
            "iperf3_captured_variation_median_s": float(np.median(over_s)),
            "iperf3_captured_variation_p95_s": float(np.percentile(over_s, 95)),
        }
    return Measured.of(values, "too few datagrams of the test are in both captures")


def _crossing(load: LoadStreams, sender: Packets, receiver: Packets) -> UdpPackets:
    sent, received = load.forward(sender), load.forward(receiver)
    return UdpPackets(sent, received, match(sent, received), *datagrams(sent), load.port)


def _demand_steady(load: LoadStreams, sender: Packets, receiver: Packets) -> Clocks | None:
    """Return how far the receiver's clock is ahead, None if packets of one direction alone show nothing of it.

    Raises:
        EvidenceError: A clock was set meanwhile.
    """
    ends = load.source_address, load.destination_address
    clocks = delay.between(sender, receiver, *ends)
    both = (packets.are_from(end).any() for packets in (sender, receiver) for end in ends)
    if clocks is None and all(both):
        raise EvidenceError(delay.UNSTEADY)
    return clocks


def _transits_ns(load: LoadStreams, sender: Packets, receiver: Packets) -> Iterator[Ints]:
    """Yield the delay of the datagrams of each stream, in the order of arrival, by the sender's clock."""
    clocks = _demand_steady(load, sender, receiver)
    if clocks is None:
        raise EvidenceError("no packet from receiver to sender is in both captures")
    crossing = _crossing(load, sender, receiver)
    if any((packets.time_ns == NO_TIME).any() for packets in (crossing.sent, crossing.received)):
        raise EvidenceError("a capture lacks times")
    first, came_ns = crossing.sent.where(crossing.first), deliveries.arrivals_ns(crossing)
    for mine in load.chosen(first):
        if (np.append(mine, False)[crossing.datagram] & crossing.match.doubtful).any():
            raise EvidenceError("packets of it look alike, and nothing shows which of them arrived when")
        whole = mine & (came_ns != NO_TIME)
        if whole.any():
            order = np.argsort(came_ns[whole], kind="stable")
            delay_s = clocks.delays_s(first.time_ns[whole][order], came_ns[whole][order])
            yield np.round(1e9 * delay_s).astype(np.int64)
