"""Loss of a UDP transfer on each layer: IP packets (including fragments), datagrams and payload bytes."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Mask, row_hashes
from fieldkit.measure.captures.packets import NO_PORT, UDP_HEADER_BYTES, Packets
from fieldkit.measure.transfers.match import Match, match, reordered
from fieldkit.measure.transfers.transfer_spec import Transfer, span_s

NO_DATAGRAM: Final = -1
"""Datagram index of a fragment whose first fragment was not captured."""


def datagrams(packets: Packets) -> tuple[Ints, Ints]:
    """Return the index of the first packet of each datagram, and the datagram index of each packet.

    A later fragment belongs to the datagram of the nearest first fragment before it with the same addresses and id.
    If all such first fragments are after it, it belongs to the nearest of them. If there are none, its datagram is
    `NO_DATAGRAM`.
    """
    is_fragment = packets.more_fragments | (packets.fragment_offset > 0)
    # An unfragmented packet has no other fragments, even if another packet has the same id.
    kind = packets.protocol << 1 | is_fragment
    key = row_hashes(*packets.src.T, *packets.dst.T, kind, packets.ip_id)
    order = np.lexsort((packets.time_ns, key))
    key, is_first = key[order], packets.fragment_offset[order] == 0
    firsts_until = np.append(0, np.cumsum(is_first))
    # The prepended value differs from the first key, so that the first packet is an edge too.
    edges = np.append(np.flatnonzero(np.diff(key, prepend=~key[:1])), len(key))
    before_key, through_key = (np.repeat(firsts_until[side], np.diff(edges)) for side in (edges[:-1], edges[1:]))
    number = np.maximum(firsts_until[1:] - 1, before_key)

    datagram = np.empty(len(packets), dtype=np.int64)
    datagram[order] = np.where(through_key > before_key, number, NO_DATAGRAM)
    return order[is_first], datagram


def with_ports(packets: Packets) -> Packets:
    """Return the packets. Later fragments have the ports of their first fragment, or `NO_PORT` without one."""
    first, datagram = datagrams(packets)
    sport, dport = (np.append(ports[first], NO_PORT)[datagram] for ports in (packets.sport, packets.dport))
    return replace(packets, sport=sport, dport=dport)


@dataclass(frozen=True, eq=False)
class UdpPackets:
    """UDP packets from sender to receiver in both captures, n sent and m received, with their match.

    Attributes:
        sent: Packets in the sender's capture.
        received: Packets in the receiver's capture.
        match: Match between the sent and the received packets.
        first: Index of the first fragment of each sent datagram. Shape (k,).
        datagram: Datagram index of each sent packet; `NO_DATAGRAM` if its first fragment is missing. Shape (n,).
        port: Destination port of the transfer.
    """

    sent: Packets
    received: Packets
    match: Match
    first: Ints
    datagram: Ints
    port: int

    @property
    def is_transfer_datagram(self) -> Mask:
        """Mask of the transfer's datagrams; the last entry is for `NO_DATAGRAM`. Shape (k + 1,)."""
        return np.append(self.sent.dport[self.first] == self.port, False)

    @property
    def is_transfer_packet(self) -> Mask:
        """Mask of the transfer's sent packets, including later fragments. Shape (n,)."""
        return self.is_transfer_datagram[self.datagram]


@dataclass(frozen=True)
class UdpCounts:
    """Counts of packets, datagrams and bytes that left the sender and that reached the receiver's interface.

    Attributes:
        packets_sent: Sent IP packets; each fragment is a packet.
        packets_received: Sent packets that arrived, without further copies.
        packets_duplicated: Further copies of sent packets that arrived.
        packets_reordered: Sent packets that arrived after a packet that was sent later (RFC 4737, section 3). None if
            packets are ambiguous.
        packets_ambiguous: Sent packets that equal other packets sent at nearly the same time, so that their arrival
            times are unknown.
        possible_copies: Received packets that may be copies and hide a loss (see `Match.possible_copy`).
        loss_bursts: Runs of consecutively sent packets that were lost. None if packets are ambiguous and some were
            lost.
        longest_burst: Number of packets in the longest run. None if `loss_bursts` is None.
        datagrams_sent: Sent datagrams.
        datagrams_received: Datagrams of which all fragments arrived.
        bytes_sent: Sent payload bytes, without UDP headers.
        bytes_received: Payload bytes that arrived, including bytes of incomplete datagrams.
        transfer_s: Time from the first to the last packet at the receiver, in seconds; None if nothing arrived, or if
            a packet has no time.
    """

    packets_sent: int
    packets_received: int
    packets_duplicated: int
    packets_reordered: int | None
    packets_ambiguous: int
    possible_copies: int
    loss_bursts: int | None
    longest_burst: int | None
    datagrams_sent: int
    datagrams_received: int
    bytes_sent: int
    bytes_received: int
    transfer_s: float | None


def match_transfer(sender: Packets, receiver: Packets, transfer: Transfer) -> UdpPackets:
    """Match the UDP packets of both captures."""
    sent, received = transfer.forward(sender), transfer.forward(receiver)
    return UdpPackets(sent, received, match(sent, received), *datagrams(sent), transfer.port)


def count(packets: UdpPackets) -> UdpCounts:
    """Return the counts of a UDP transfer."""
    sent, received, matched = packets.sent, packets.received, packets.match
    arrived, is_sent = matched.arrived, packets.is_transfer_packet
    complete_datagrams = complete(packets)
    payload = payload_bytes(sent)
    is_received = np.append(is_sent, False)[matched.sent_index]  # `match.NONE` (-1) selects the appended False
    bursts = _bursts(~arrived[is_sent])
    time_ns = received.time_ns[is_received]
    ambiguous_count = int((is_sent & matched.ambiguous).sum())
    are_bursts_known = not ambiguous_count or bool(arrived[is_sent].all())
    return UdpCounts(
        packets_sent=int(is_sent.sum()),
        packets_received=int((is_sent & arrived).sum()),
        packets_duplicated=int((is_received & matched.duplicates).sum()),
        packets_reordered=(
            None if ambiguous_count else int(reordered(matched.sent_index[is_received & ~matched.duplicates]).sum())
        ),
        packets_ambiguous=ambiguous_count,
        possible_copies=int((is_received & matched.possible_copy).sum()),
        loss_bursts=len(bursts) if are_bursts_known else None,
        longest_burst=int(bursts.max(initial=0)) if are_bursts_known else None,
        datagrams_sent=int(packets.is_transfer_datagram.sum()),
        datagrams_received=int((packets.is_transfer_datagram & complete_datagrams).sum()),
        bytes_sent=int(payload[is_sent].sum()),
        bytes_received=int(payload[is_sent & arrived].sum()),
        transfer_s=span_s(time_ns, np.ones(len(time_ns), dtype=np.bool_)),
    )


def payload_bytes(packets: Packets) -> Ints:
    """Return the number of application bytes in each packet."""
    return packets.ip_payload_bytes - np.where(packets.fragment_offset == 0, UDP_HEADER_BYTES, 0)


def complete(packets: UdpPackets) -> Mask:
    """Return a mask of the datagrams that were sent and arrived completely; the last entry is for `NO_DATAGRAM`."""
    sent, first = packets.sent, packets.first
    has_datagram = packets.datagram != NO_DATAGRAM
    datagram, lost = packets.datagram[has_datagram], ~packets.match.arrived[has_datagram]
    missing = np.bincount(datagram, weights=lost, minlength=len(first))
    size = np.bincount(datagram, weights=sent.ip_payload_bytes[has_datagram], minlength=len(first))
    return np.append((missing == 0) & (size >= sent.udp_bytes[first]), False)


def _bursts(lost: Mask) -> Ints:
    """Return the length of each run of consecutive losses."""
    edges = np.flatnonzero(np.diff(lost, prepend=False, append=False))
    return edges[1::2] - edges[::2]
