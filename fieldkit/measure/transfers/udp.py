"""Loss of a UDP transfer layer by layer: IP packets (fragments), datagrams, payload bytes."""

from dataclasses import dataclass

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Mask
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES, Packets
from fieldkit.measure.transfers.datagrams import NO_DATAGRAM, datagrams
from fieldkit.measure.transfers.match import Match, match, reordered
from fieldkit.measure.transfers.transfer import Transfer, span_s


@dataclass(frozen=True, eq=False)
class UdpPackets:
    """UDP packets from sender to receiver in both captures, beside each other: n sent, m received.

    Attributes:
        sent: In the sender's capture.
        received: In the receiver's.
        match: Which of these is a copy of which of those.
        first: Index of the first fragment of each datagram sent. Of shape (k,).
        datagram: Datagram of each packet sent, `NO_DATAGRAM` where its first fragment is not there. Of shape (n,).
        port: Port that the transfer goes to.
    """

    sent: Packets
    received: Packets
    match: Match
    first: Ints
    datagram: Ints
    port: int

    @property
    def ours(self) -> Mask:
        """Which datagrams are the transfer's; the last entry is that of `NO_DATAGRAM`. Of shape (k + 1,)."""
        return np.append(self.sent.dport[self.first] == self.port, False)

    @property
    def chosen(self) -> Mask:
        """Which packets sent are the transfer's, later fragments too. Of shape (n,)."""
        return self.ours[self.datagram]


@dataclass(frozen=True)
class UdpCounts:
    """Counts of what left the sender, and of what reached the receiver's interface.

    Attributes:
        packets_sent: IP packets, fragments counted singly.
        packets_received: Of these, the ones that arrived; a duplicate counts once.
        packets_duplicated: Further copies that arrived of these.
        packets_reordered: Of these, the ones that arrived after one that was sent later (RFC 4737, section 3). None
            where packets are doubtful.
        packets_doubtful: Of the packets sent, the ones that look like others and were sent so close to them that
            nothing tells which of them arrived when.
        packets_dubious: Of the packets received, the ones that may be copies that hide a loss: see `Match.dubious`.
        loss_bursts: Runs of packets lost that were sent one after the other. None where packets are doubtful, unless
            none was lost.
        longest_burst: Packets in the longest of these, likewise.
        datagrams_sent: Datagrams.
        datagrams_received: Of these, the ones of which every fragment arrived.
        bytes_sent: Payload bytes, UDP headers left out.
        bytes_received: Of these, the ones that arrived, in whole datagrams or not.
        transfer_s: First to last packet at the receiver, in seconds; None when nothing arrived.
    """

    packets_sent: int
    packets_received: int
    packets_duplicated: int
    packets_reordered: int | None
    packets_doubtful: int
    packets_dubious: int
    loss_bursts: int | None
    longest_burst: int | None
    datagrams_sent: int
    datagrams_received: int
    bytes_sent: int
    bytes_received: int
    transfer_s: float | None


def cross(sender: Packets, receiver: Packets, transfer: Transfer) -> UdpPackets:
    """Return the UDP packets of both captures beside each other."""
    sent, received = transfer.forward(sender), transfer.forward(receiver)
    return UdpPackets(sent, received, match(sent, received), *datagrams(sent), transfer.port)


def count(crossing: UdpPackets) -> UdpCounts:
    """Return the counts of a UDP transfer."""
    sent, received, matched = crossing.sent, crossing.received, crossing.match
    arrived, chosen = matched.arrived, crossing.chosen
    whole_datagrams = whole(crossing)
    payload = payload_bytes(sent)
    came = np.append(chosen, False)[matched.sent_index]  # the last entry is that of match.NONE
    bursts = _bursts(~arrived[chosen])
    time_ns = received.time_ns[came]
    doubtful = int((chosen & matched.doubtful).sum())
    bursts_told = not doubtful or bool(arrived[chosen].all())
    return UdpCounts(
        packets_sent=int(chosen.sum()),
        packets_received=int((chosen & arrived).sum()),
        packets_duplicated=int((came & matched.duplicates).sum()),
        packets_reordered=(
            None if doubtful else int(reordered(matched.sent_index[came & ~matched.duplicates]).sum())
        ),
        packets_doubtful=doubtful,
        packets_dubious=int((came & matched.dubious).sum()),
        loss_bursts=len(bursts) if bursts_told else None,
        longest_burst=int(bursts.max(initial=0)) if bursts_told else None,
        datagrams_sent=int(crossing.ours.sum()),
        datagrams_received=int((crossing.ours & whole_datagrams).sum()),
        bytes_sent=int(payload[chosen].sum()),
        bytes_received=int(payload[chosen & arrived].sum()),
        transfer_s=span_s(time_ns, np.ones(len(time_ns), dtype=np.bool_)),
    )


def payload_bytes(packets: Packets) -> Ints:
    """Return the bytes that each packet carries for the application."""
    return packets.ip_payload_bytes - np.where(packets.fragment_offset == 0, UDP_HEADER_BYTES, 0)


def whole(crossing: UdpPackets) -> Mask:
    """Return whether all of each datagram was sent and arrived; the last entry is that of `NO_DATAGRAM`."""
    sent, first = crossing.sent, crossing.first
    known = crossing.datagram != NO_DATAGRAM
    datagram, lost = crossing.datagram[known], ~crossing.match.arrived[known]
    missing = np.bincount(datagram, weights=lost, minlength=len(first))
    size = np.bincount(datagram, weights=sent.ip_payload_bytes[known], minlength=len(first))
    return np.append((missing == 0) & (size >= sent.udp_bytes[first]), False)


def _bursts(lost: Mask) -> Ints:
    """Return the lengths of the runs of losses."""
    turns = np.flatnonzero(np.diff(lost, prepend=False, append=False))
    return turns[1::2] - turns[::2]
