"""Match packets received with packets sent, by what is equal in a packet at both ends.

Packets that look alike (16-bit IP ids come again in a long transfer, or are 0 throughout in packets that are never
fragmented: RFC 6864, section 4) are told apart by time, in the order in which they were sent.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Keys, Mask, mixed
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import ranges
from fieldkit.measure.transfers.ranges import Pieces

NONE: Final = -1
"""Index of a packet that is not there."""


@dataclass(frozen=True, eq=False)
class Match:
    """Packets of two captures beside each other, n sent and m received.

    Attributes:
        received_index: Per packet sent, the index of its first copy among those received; `NONE` when lost. Of
            shape (n,).
        sent_index: Per packet received, the index of the one sent that it is a copy of; `NONE` when nobody is seen
            to have sent it. Of shape (m,).
        duplicates: Packets received that are further copies of what had arrived. Of shape (m,).
        doubtful: Packets sent that look like others of which not all arrived: which of them did is told by time
            alone. Of shape (n,).
    """

    received_index: Ints
    sent_index: Ints
    duplicates: Mask
    doubtful: Mask

    @property
    def arrived(self) -> Mask:
        """Which of the packets sent arrived. Of shape (n,)."""
        arrived: Mask = self.received_index != NONE
        return arrived


@dataclass(frozen=True, eq=False)
class Payload:
    """TCP payload of two captures beside each other, in comparable pieces.

    Attributes:
        sent: Pieces sent.
        received: Pieces received.
        match: Which piece received is the copy of which piece sent.
    """

    sent: Pieces
    received: Pieces
    match: Match


def match(sent: Packets, received: Packets) -> Match:
    """Return which of the packets received are copies of which sent.

    Packets are copies of each other when addresses, protocol, IP id, fragment offset, length, ports, and TCP's
    numbers and flags are equal. Of n alike sent and m received, min(n, m) arrived.

    Segmentation offload lets the two ends see other TCP frames: one that has no equal at the other end belongs to the
    frame that carries its first byte, and is a duplicate if all of its bytes are.

    Args:
        sent: Packets captured at the sender.
        received: Packets captured at the receiver, whose clock may be any.

    Raises:
        EvidenceError: See `ranges.cut`.
    """
    frames = _frames(sent, received)
    carried = _payload(sent, received, frames)
    for mine, theirs, index, piece_index in (
        (carried.sent, carried.received, frames.received_index, carried.match.received_index),
        (carried.received, carried.sent, frames.sent_index, carried.match.sent_index),
    ):
        frame, first = np.unique(mine.frame, return_index=True)
        index[frame] = np.append(theirs.frame, NONE)[piece_index[first]]
    frames.doubtful[carried.sent.frame[carried.match.doubtful]] = True
    frames.duplicates[carried.received.frame] = True
    frames.duplicates[carried.received.frame[~carried.match.duplicates]] = False
    return frames


def match_payload(sent: Packets, received: Packets) -> Payload:
    """Return which of the TCP payload received is a copy of which sent.

    A piece belongs to the equal frame at the other end where there is one; what is left, of frames that segmentation
    offload cut or joined, to a piece of the same bytes: of n sent and m received, min(n, m) arrived.

    Args:
        sent: Packets captured at the sender.
        received: Packets captured at the receiver, whose clock may be any.

    Raises:
        EvidenceError: See `ranges.cut`.
    """
    return _payload(sent, received, _frames(sent, received))


def paired(key: Keys, time_ns: Ints, received_key: Keys, received_time_ns: Ints) -> Match:
    """Return the match of things sent and received that are copies of each other only if their keys are equal.

    Args:
        key: Of each thing sent. Shape (n,).
        time_ns: When it was sent.
        received_key: Of each thing received. Shape (m,).
        received_time_ns: When it was received, by any clock.
    """
    left, came = np.lexsort((time_ns, key)), np.lexsort((received_time_ns, received_key))
    keys, group = np.unique(key[left], return_inverse=True)
    came_group = np.searchsorted(keys, received_key[came])
    known = (came_group < len(keys)) & (np.append(keys, np.uint64(0))[came_group] == received_key[came])
    came, came_group = came[known], came_group[known]
    sent, received = np.bincount(group, minlength=len(keys)), np.bincount(came_group, minlength=len(keys))

    place = places(group, time_ns[left], came_group, received_time_ns[came])
    sent_index = np.full(len(received_key), NONE)
    sent_index[came] = left[(np.cumsum(sent) - sent)[came_group] + place]
    received_index = np.full(len(key), NONE)
    # Of several values for one place numpy keeps the last, here the earliest copy.
    received_index[sent_index[came[::-1]]] = came[::-1]
    duplicates: Mask = sent_index != NONE
    duplicates[received_index[received_index != NONE]] = False
    doubtful = np.zeros(len(key), dtype=np.bool_)
    doubtful[left] = ((sent > 1) & (received > 0) & (received < sent))[group]
    return Match(received_index, sent_index, duplicates, doubtful)


def reordered(sent_index: Ints) -> Mask:
    """Return which arrived after one that was sent later (RFC 4737, section 3).

    Args:
        sent_index: Place in the order of sending of each thing received, in the order of arrival.
    """
    late: Mask = sent_index < np.maximum.accumulate(sent_index)
    return late


def _frames(sent: Packets, received: Packets) -> Match:
    """Return the match of packets that are equal at both ends."""
    return paired(_key(sent), sent.time_ns, _key(received), received.time_ns)


def _payload(sent: Packets, received: Packets, frames: Match) -> Payload:
    left, came = ranges.cut(sent, received)
    # The number of the equal frame, 0 where there is none.
    copy, came_copy = np.where(frames.arrived, np.arange(len(sent)), NONE) + 1, frames.sent_index + 1
    pieces = paired(
        mixed(left.stretch, copy[left.frame]),
        sent.time_ns[left.frame],
        mixed(came.stretch, came_copy[came.frame]),
        received.time_ns[came.frame],
    )
    return Payload(left, came, replace(pieces, doubtful=pieces.doubtful | frames.doubtful[left.frame]))


def _key(packets: Packets) -> Keys:
    """Return a number that is equal for packets that are alike, and for others by a chance of one in 2**48."""
    places = (packets.ip_id << 16 | packets.fragment_offset, packets.ip_payload_bytes << 8 | packets.protocol)
    ports = packets.sport + 1 << 20 | packets.dport + 1
    key = mixed(
        *packets.src.T, *packets.dst.T, *places, ports, packets.tcp_seq << 32 | packets.tcp_ack, packets.tcp_flags
    )
    # IP ids mostly rise: numbers that rise with them are faster to sort.
    return packets.ip_id.astype(np.uint64) << np.uint64(48) | key >> np.uint64(16)


def places(group: Ints, time_ns: Ints, came_group: Ints, came_time_ns: Ints) -> Ints:
    """Return, per thing received, which of those alike it is a copy of: 0 for the first that was sent, and so on.

    In each group each is taken for the nearest in time, as far as order allows and as all of the fewer side, sent or
    received, find one.

    Args:
        group: Group of those alike, of each thing sent, in ascending order.
        time_ns: When it was sent, in ascending order within its group.
        came_group: Group of each thing received, likewise.
        came_time_ns: When it was received, likewise.
    """
    sent, received = (np.bincount(these, minlength=len(group)) for these in (group, came_group))
    place = np.zeros(len(came_group), dtype=np.int64)
    many = sent > 1
    chosen, left = many[came_group], many[group]
    if not chosen.any():
        return place
    even = sent == received
    offset_ns = _clock_offset_ns(time_ns, even[group], came_time_ns, even[came_group])
    group, time_ns = group[left], time_ns[left]
    came_group, came_time_ns = came_group[chosen], came_time_ns[chosen] - offset_ns
    sent, received = sent * many, received * many
    rank = np.arange(len(came_group)) - (np.cumsum(received) - received)[came_group]
    spare = (sent - received)[came_group]
    skipped = _nearest(group, time_ns, came_group, came_time_ns) - rank
    # Where fewer came, some of those sent are skipped; where more came, some of those sent have several copies.
    sign = np.where(spare < 0, -1, 1)
    skipped = np.clip(sign * skipped, 0, np.abs(spare))
    apart = came_group * (len(group) + len(came_group))
    place[chosen] = rank + sign * (np.maximum.accumulate(skipped + apart) - apart)
    return place


def _nearest(group: Ints, time_ns: Ints, came_group: Ints, came_time_ns: Ints) -> Ints:
    """Return, per thing received, the place of the one sent in its group that is nearest in time."""
    sent = np.bincount(group)
    order = np.lexsort((np.concatenate((time_ns, came_time_ns)), np.concatenate((group, came_group))))
    is_sent = order < len(group)
    first, last = (np.cumsum(sent) - sent)[came_group], np.cumsum(sent)[came_group] - 1
    after = np.cumsum(is_sent)[~is_sent]
    earlier, later = np.maximum(after - 1, first), np.minimum(after, last)
    nearest: Ints = np.where(came_time_ns - time_ns[earlier] < time_ns[later] - came_time_ns, earlier, later) - first
    return nearest


def _clock_offset_ns(sent_ns: Ints, sent_even: Mask, received_ns: Ints, received_even: Mask) -> int:
    """Return the receiver's clock minus the sender's, delay included, from the groups of which all arrived."""
    if not sent_even.any():
        return int(received_ns.min() - sent_ns.min())
    return int(np.median(received_ns[received_even] - sent_ns[sent_even]))
