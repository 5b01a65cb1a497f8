"""Loss of a UDP transfer on each layer: IP packets (fragments), datagrams, payload bytes."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Mask, row_hashes
from fieldkit.measure.captures.packets import NO_PORT, UDP_HEADER_BYTES, Packets
from fieldkit.measure.transfers.match import Match, match, reordered
from fieldkit.measure.transfers.transfer_spec import Transfer, span_s

NO_DATAGRAM: Final = -1


def datagrams(packets: Packets) -> tuple[Ints, Ints]:
    """Return the index of each datagram's first packet, and the datagram of each packet.

    A later fragment belongs to the latest first fragment with the same addresses and id, or to the next first
    fragment if there is none before it. Its datagram is `NO_DATAGRAM` if there is neither.
    """
    is_fragment = packets.more_fragments | (packets.fragment_offset > 0)
    # An unfragmented packet has no other fragments, even if another packet has the same id.
    kind = packets.protocol << 1 | is_fragment
    key = row_hashes(*packets.src.T, *packets.dst.T, kind, packets.ip_id)
    order = np.lexsort((packets.time_ns, key))
    key, is_first = key[order], packets.fragment_offset[order] == 0
    firsts_until = np.append(0, np.cumsum(is_first))
    edges = np.append(np.flatnonzero(np.diff(key, prepend=~key[:1])), len(key))
    before_key, through_key = (np.repeat(firsts_until[side], np.diff(edges)) for side in (edges[:-1], edges[1:]))
    number = np.maximum(firsts_until[1:] - 1, before_key)

    datagram = np.empty(len(packets), dtype=np.int64)
    datagram[order] = np.where(through_key > before_key, number, NO_DATAGRAM)
    return order[is_first], datagram


def with_ports(packets: Packets) -> Packets:
    """Return the packets; later fragments get the ports of their first fragment, or `NO_PORT` without one."""
    first, datagram = datagrams(packets)
    sport, dport = (np.append(ports[first], NO_PORT)[datagram] for ports in (packets.sport, packets.dport))
    return replace(packets, sport=sport, dport=dport)


@dataclass(frozen=True, eq=False)
class UdpPackets:
    """The n UDP packets sent and m received from sender to receiver in both captures, with their match.

    Attributes:
        sent: Packets in the sender's capture.
        received: Packets in the receiver's capture.
        match: Match between them.
        first: Index of the first fragment of each sent datagram. Shape (k,).
        datagram: Datagram of each sent packet, `NO_DATAGRAM` if its first fragment is missing. Shape (n,).
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
        packets_sent: IP packets, each fragment separately.
        packets_received: Sent packets that arrived; a duplicate counts once.
        packets_duplicated: Further copies of sent packets that arrived.
        packets_reordered: Sent packets that arrived after one that was sent later (RFC 4737, section 3). None if
            packets are ambiguous.
        packets_ambiguous: Sent packets that equal others sent at nearly the same time, so that the time of arrival of
            each is unknown.
        possible_copies: Received packets that may be copies and hide a loss: see `Match.possible_copy`.
        loss_bursts: Runs of lost packets that were sent consecutively. None if packets are ambiguous and some were
            lost.
        longest_burst: Packets in the longest run. None if `loss_bursts` is None.
        datagrams_sent: Datagrams.
        datagrams_received: Datagrams all of whose fragments arrived.
        bytes_sent: Payload bytes without UDP headers.
        bytes_received: Payload bytes that arrived, whether in complete datagrams or not.
        transfer_s: Time from the first to the last packet at the receiver, in seconds; None if nothing arrived.
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
    arrived, chosen = matched.arrived, packets.is_transfer_packet
    complete_datagrams = complete(packets)
    payload = payload_bytes(sent)
    received_chosen = np.append(chosen, False)[matched.sent_index]  # the last entry is for match.NONE
    bursts = _bursts(~arrived[chosen])
    time_ns = received.time_ns[received_chosen]
    ambiguous = int((chosen & matched.ambiguous).sum())
    bursts_known = not ambiguous or bool(arrived[chosen].all())
    return UdpCounts(
        packets_sent=int(chosen.sum()),
        packets_received=int((chosen & arrived).sum()),
        packets_duplicated=int((received_chosen & matched.duplicates).sum()),
        packets_reordered=(
            None if ambiguous else int(reordered(matched.sent_index[received_chosen & ~matched.duplicates]).sum())
        ),
        packets_ambiguous=ambiguous,
        possible_copies=int((received_chosen & matched.possible_copy).sum()),
        loss_bursts=len(bursts) if bursts_known else None,
        longest_burst=int(bursts.max(initial=0)) if bursts_known else None,
        datagrams_sent=int(packets.is_transfer_datagram.sum()),
        datagrams_received=int((packets.is_transfer_datagram & complete_datagrams).sum()),
        bytes_sent=int(payload[chosen].sum()),
        bytes_received=int(payload[chosen & arrived].sum()),
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
    """Return the length of each run of losses."""
    edges = np.flatnonzero(np.diff(lost, prepend=False, append=False))
    return edges[1::2] - edges[::2]
