"""Loss of a UDP transfer layer by layer: IP packets (fragments), datagrams, payload bytes.

Only the first fragment of a datagram carries the port; the others belong to it by their IP id, which has 16 bits and
comes again in a long transfer, or at once in packets that are never fragmented (RFC 6864, section 4).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.measure.packets import Ints, Mask, Packets
from fieldkit.measure.transfer import Transfer, span_s

_NO_DATAGRAM: Final = -1
_HEADER_BYTES: Final = 8


@dataclass(frozen=True)
class UdpCounts:
    """What left the sender, and what of it reached the receiver's interface.

    Attributes:
        packets_sent: IP packets, fragments counted singly.
        packets_received: Of these, the ones that arrived; a duplicate counts once.
        datagrams_sent: Datagrams.
        datagrams_received: Of these, the ones of which every fragment arrived.
        bytes_sent: Payload bytes, UDP headers left out.
        bytes_received: Of these, the ones that arrived, in whole datagrams or not.
        transfer_s: First to last packet at the receiver, in seconds; None when nothing arrived.
    """

    packets_sent: int
    packets_received: int
    datagrams_sent: int
    datagrams_received: int
    bytes_sent: int
    bytes_received: int
    transfer_s: float | None


def count(sender: Packets, receiver: Packets, transfer: Transfer) -> UdpCounts:
    """Return the counts of a UDP transfer, given the packets of both captures."""
    sent, received = transfer.forward(sender), transfer.forward(receiver)
    key, received_key = _key(sent), _key(received)
    arrived = _arrived(key, sent.time_ns, received_key, received.time_ns)
    first, datagram = _datagrams(sent)

    ours = np.append(sent.dport[first] == transfer.port, False)  # the last entry is that of _NO_DATAGRAM
    chosen = ours[datagram]
    whole = _whole(sent, arrived, first, datagram)
    payload = sent.ip_payload_bytes - np.where(sent.fragment_offset == 0, _HEADER_BYTES, 0)
    time_ns = received.time_ns[np.isin(received_key, key[chosen])]
    return UdpCounts(
        packets_sent=int(chosen.sum()),
        packets_received=int((chosen & arrived).sum()),
        datagrams_sent=int(ours.sum()),
        datagrams_received=int((ours[:-1] & whole).sum()),
        bytes_sent=int(payload[chosen].sum()),
        bytes_received=int(payload[chosen & arrived].sum()),
        transfer_s=span_s(time_ns, np.ones(len(time_ns), dtype=np.bool_)),
    )


def _key(packets: Packets) -> Ints:
    """Return what is equal in a packet at both ends: IP id, offset, length and, where it carries one, the port."""
    place = packets.ip_id << 13 | packets.fragment_offset // 8
    return (place << 16 | packets.ip_payload_bytes) << 17 | packets.dport + 1


def _datagrams(packets: Packets) -> tuple[Ints, Ints]:
    """Return the index of each datagram's first fragment, and each packet's datagram.

    A later fragment belongs to the latest first fragment with its id; one seen before any, to the next.
    """
    order = np.lexsort((packets.time_ns, packets.ip_id))
    ip_id = packets.ip_id[order]
    is_first = packets.fragment_offset[order] == 0
    firsts_until = np.append(0, np.cumsum(is_first))
    before_id = firsts_until[np.searchsorted(ip_id, ip_id, side="left")]
    through_id = firsts_until[np.searchsorted(ip_id, ip_id, side="right")]
    number = np.maximum(firsts_until[1:] - 1, before_id)

    datagram = np.empty(len(packets), dtype=np.int64)
    datagram[order] = np.where(through_id > before_id, number, _NO_DATAGRAM)
    return order[is_first], datagram


def _whole(sent: Packets, arrived: Mask, first: Ints, datagram: Ints) -> Mask:
    """Return, per datagram, whether all of it was sent and all of that arrived."""
    known = datagram != _NO_DATAGRAM
    lost = np.bincount(datagram[known], weights=~arrived[known], minlength=len(first))
    size = np.bincount(datagram[known], weights=sent.ip_payload_bytes[known], minlength=len(first))
    whole: Mask = (lost == 0) & (size >= sent.udp_bytes[first])
    return whole


def _arrived(key: Ints, time_ns: Ints, received_key: Ints, received_time_ns: Ints) -> Mask:
    """Return, per packet sent, whether it arrived: of n alike sent and m received, min(n, m)."""
    keys, at, sent = np.unique(key, return_inverse=True, return_counts=True)
    known = np.isin(received_key, keys)
    received_at = np.searchsorted(keys, received_key[known])
    received = np.bincount(received_at, minlength=len(keys))
    arrived: Mask = (received >= sent)[at]

    doubtful = np.flatnonzero((received > 0) & (received < sent))
    if not len(doubtful):
        return arrived
    order = np.lexsort((time_ns, at))
    sent_ns = time_ns[order]
    received_ns = received_time_ns[known][np.lexsort((received_time_ns[known], received_at))]
    received_ns = received_ns - _clock_offset_ns(sent_ns, sent, received_ns, received)
    sent_end, received_end = np.cumsum(sent), np.cumsum(received)
    for one in doubtful:
        alike = slice(sent_end[one] - sent[one], sent_end[one])
        came = slice(received_end[one] - received[one], received_end[one])
        arrived[order[alike][_nearest(sent_ns[alike], received_ns[came])]] = True
    return arrived


def _clock_offset_ns(sent_ns: Ints, sent: Ints, received_ns: Ints, received: Ints) -> int:
    """Return the receiver's clock minus the sender's, delay included, from the keys received as often as sent.

    Args:
        sent_ns: Times by key, then time.
        sent: How many of them each key has.
        received_ns: Times by key, then time.
        received: How many of them each key has.
    """
    even = sent == received
    if not even.any():
        return int(received_ns.min() - sent_ns.min())
    return int(np.median(received_ns[np.repeat(even, received)] - sent_ns[np.repeat(even, sent)]))


def _nearest(sent_ns: Ints, received_ns: Ints) -> list[int]:
    """Return, per packet received, the packet sent nearest in time that leaves one for each of the others."""
    chosen: list[int] = []
    after = np.searchsorted(sent_ns, received_ns)
    for index, (moment, right) in enumerate(zip(received_ns, after, strict=True)):
        near = int(right)
        if near == len(sent_ns) or (near > 0 and moment - sent_ns[near - 1] < sent_ns[near] - moment):
            near -= 1
        soonest = chosen[-1] + 1 if chosen else 0
        latest = len(sent_ns) - (len(received_ns) - index)
        chosen.append(min(max(near, soonest), latest))
    return chosen
