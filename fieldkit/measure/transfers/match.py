"""Match packets received with packets sent, by what is equal in a packet at both ends.

Headers may look alike: 16-bit IP ids come again in a long transfer, or are 0 throughout in packets that are never
fragmented (RFC 6864, section 4), and a retransmission repeats its sequence numbers. Such packets are told apart by
their content or by TCP's time stamps, else by time if they were sent far enough from each other; what is left is in
doubt.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Keys, Mask, mixed
from fieldkit.measure.captures.ip import TCP
from fieldkit.measure.captures.packets import NO_STAMP, NOT_KEPT, RST, Packets
from fieldkit.measure.transfers import ranges
from fieldkit.measure.transfers.ranges import Pieces

NONE: Final = -1
"""Index of a packet that is not there."""

APART_NS: Final = 200_000_000
"""Packets that look alike may be told apart by time if they were sent so far from each other at least.

What is later than that Linux's TCP takes for lost, too (its least retransmission time-out, TCP_RTO_MIN).
"""

_CLEAR: Final = 4
"""Time tells which of two was sent if it is off by at most this part of the time between them."""


@dataclass(frozen=True, eq=False)
class Match:
    """Packets of two captures beside each other, n sent and m received.

    Attributes:
        received_index: Per packet sent, the index of its first copy among those received; `NONE` when lost. Of
            shape (n,).
        sent_index: Per packet received, the index of the one sent that it is a copy of; `NONE` when nobody is seen
            to have sent it. Of shape (m,).
        duplicates: Packets received that are further copies of what had arrived. Of shape (m,).
        doubtful: Packets sent that look like others and were sent too close to them: which of them arrived, and in
            which order, nothing tells. They are matched in the order of sending, so that of n sent and m received
            min(n, m) arrived. Of shape (n,).
        dubious: Packets received that count as arrived, and may be copies all the same: of those that look like them
            some did not come as far from each other as they were sent. Of shape (m,).
    """

    received_index: Ints
    sent_index: Ints
    duplicates: Mask
    doubtful: Mask
    dubious: Mask

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
    numbers, flags and time stamp are equal, and content where several of them are.

    Segmentation offload lets the two ends see other TCP frames: one that has no equal at the other end belongs to the
    frame that carries its first byte, and is a duplicate if all of its bytes are.

    Args:
        sent: Packets captured at the sender.
        received: Packets captured at the receiver, whose clock may be any.

    Raises:
        EvidenceError: See `ranges.cut`.
    """
    frames = _frames(sent, received)
    if not sent.tcp_payload_bytes.any() and not received.tcp_payload_bytes.any():
        return frames
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

    A piece belongs to a piece of the same bytes in a frame with the same time stamp. Where frames have IP ids it
    belongs to the equal frame at the other end, if there is one: segmentation offload cuts and joins the others.

    Args:
        sent: Packets captured at the sender.
        received: Packets captured at the receiver, whose clock may be any.

    Raises:
        EvidenceError: See `ranges.cut`.
    """
    return _payload(sent, received, _frames(sent, received))


def paired(
    key: Keys,
    time_ns: Ints,
    received_key: Keys,
    received_time_ns: Ints,
    *,
    contents: tuple[Ints, Ints] | None = None,
) -> Match:
    """Return the match of things sent and received that are copies of each other only if their keys are equal.

    Args:
        key: Of each thing sent. Shape (n,).
        time_ns: When it was sent.
        received_key: Of each thing received. Shape (m,).
        received_time_ns: When it was received, by any clock.
        contents: Of each thing sent and received, what tells those of one key apart; `NOT_KEPT` where it is
            unknown.
    """
    left, came = np.lexsort((time_ns, key)), np.lexsort((received_time_ns, received_key))
    keys, group = np.unique(key[left], return_inverse=True)
    sent = np.bincount(group, minlength=len(keys))
    if contents is not None and (sent > 1).any():
        finer = _told_by_content(keys[sent > 1], (key, received_key), contents)
        return paired(finer[0], time_ns, finer[1], received_time_ns)
    came_group = np.searchsorted(keys, received_key[came])
    known = (came_group < len(keys)) & (np.append(keys, np.uint64(0))[came_group] == received_key[came])
    came, came_group = came[known], came_group[known]
    received = np.bincount(came_group, minlength=len(keys))

    place, told, apart = places(group, time_ns[left], came_group, received_time_ns[came])
    sent_index = np.full(len(received_key), NONE)
    sent_index[came] = left[(np.cumsum(sent) - sent)[came_group] + place]
    received_index = np.full(len(key), NONE)
    # Of several values for one place numpy keeps the last, here the earliest copy.
    received_index[sent_index[came[::-1]]] = came[::-1]
    duplicates: Mask = sent_index != NONE
    duplicates[received_index[received_index != NONE]] = False
    doubtful = np.zeros(len(key), dtype=np.bool_)
    doubtful[left] = (~told & (received > 0))[group]
    dubious = np.zeros(len(received_key), dtype=np.bool_)
    # A single one that arrived is the copy of none, whichever it is.
    dubious[came] = (~told & ~apart & (received > 1))[came_group]
    dubious &= ~duplicates
    return Match(received_index, sent_index, duplicates, doubtful, dubious)


def reordered(sent_index: Ints) -> Mask:
    """Return which arrived after one that was sent later (RFC 4737, section 3).

    Args:
        sent_index: Place in the order of sending of each thing received, in the order of arrival.
    """
    late: Mask = sent_index < np.maximum.accumulate(sent_index)
    return late


def stamps(sent: Packets, received: Packets) -> tuple[Ints, Ints]:
    """Return TCP's time stamp of packets sent and received, `NO_STAMP` in all of a connection that is without it.

    Where one was agreed upon, every frame but a reset has it (RFC 7323, section 3.2). It is of no use where something
    on the way took it out, or a capture cut it off.
    """
    lacking = [
        (packets.protocol == TCP) & (packets.tcp_stamp == NO_STAMP) & (packets.tcp_flags & RST == 0)
        for packets in (sent, received)
    ]
    if not any(these.any() for these in lacking):
        return sent.tcp_stamp, received.tcp_stamp
    connections = [connection(packets) for packets in (sent, received)]
    without = np.concatenate([numbers[these] for numbers, these in zip(connections, lacking, strict=True)])
    left, came = (
        np.where(np.isin(these, without), NO_STAMP, packets.tcp_stamp)
        for packets, these in zip((sent, received), connections, strict=True)
    )
    return left, came


def connection(packets: Packets) -> Keys:
    """Return a number per packet that is equal for equal addresses and ports."""
    return mixed(*packets.src.T, *packets.dst.T, packets.sport + 1 << 20 | packets.dport + 1)


def _frames(sent: Packets, received: Packets) -> Match:
    """Return the match of packets that are equal at both ends."""
    stamp, came_stamp = stamps(sent, received)
    contents = sent.content, received.content
    return paired(_key(sent, stamp), sent.time_ns, _key(received, came_stamp), received.time_ns, contents=contents)


def _payload(sent: Packets, received: Packets, frames: Match) -> Payload:
    left, came = ranges.cut(sent, received)
    stamp, came_stamp = stamps(sent, received)
    key, came_key = mixed(left.stretch, stamp[left.frame]), mixed(came.stretch, came_stamp[came.frame])
    copy, came_copy = _copies(sent, received, frames)
    copy, came_copy = copy[left.frame], came_copy[came.frame]
    # Without a time stamp a frame received that offload cut or joined may be a part of any.
    unknown = (came_copy == 0) & (came_stamp[came.frame] == NO_STAMP)
    unknown |= ~np.isin(mixed(came_key, came_copy), mixed(key, copy))
    came_copy = np.where(unknown, NOT_KEPT, came_copy)
    pieces = paired(
        key,
        sent.time_ns[left.frame],
        came_key,
        received.time_ns[came.frame],
        contents=(copy, came_copy),
    )
    doubtful = pieces.doubtful | frames.doubtful[left.frame] & (copy > 0)
    return Payload(left, came, replace(pieces, doubtful=doubtful))


def _copies(sent: Packets, received: Packets, frames: Match) -> tuple[Ints, Ints]:
    """Return the number of the frame that is equal at the other end, 0 where there is none: told by its IP id."""
    connections = [connection(packets) for packets in (sent, received)]
    carries = sent.tcp_payload_bytes > 0
    _, one_of_each = np.unique(mixed(connections[0][carries], sent.ip_id[carries]), return_index=True)
    these, ids = np.unique(connections[0][carries][one_of_each], return_counts=True)
    # Of frames that all have one id any may be a part of another.
    named, came_named = (~np.isin(numbers, these[ids < 2]) for numbers in connections)
    copy = np.where(frames.arrived & named, np.arange(len(sent)), NONE) + 1
    came_copy = np.where(came_named, frames.sent_index, NONE) + 1
    return copy, came_copy


def _key(packets: Packets, stamp: Ints) -> Keys:
    """Return a number that is equal for packets that are alike, and for others by a chance of one in 2**48."""
    places = (packets.ip_id << 16 | packets.fragment_offset, packets.ip_payload_bytes << 8 | packets.protocol)
    tcp = (packets.tcp_seq << 32 | packets.tcp_ack, packets.tcp_flags << 33 | stamp + 1)
    key = connection(packets)
    key = mixed(key, *places, *tcp)
    # IP ids mostly rise: numbers that rise with them are faster to sort.
    return packets.ip_id.astype(np.uint64) << np.uint64(48) | key >> np.uint64(16)


def _told_by_content(alike: Keys, keys: tuple[Keys, Keys], contents: tuple[Ints, Ints]) -> tuple[Keys, Keys]:
    """Return keys in which content is, of those that are `alike`: where it is known of all that have one key."""
    unknown = np.concatenate([key[content == NOT_KEPT] for key, content in zip(keys, contents, strict=True)])
    alike = np.setdiff1d(alike, unknown)
    left, came = (
        np.where(np.isin(key, alike), mixed(key, content), key) for key, content in zip(keys, contents, strict=True)
    )
    return left, came


def places(group: Ints, time_ns: Ints, came_group: Ints, came_time_ns: Ints) -> tuple[Ints, Mask, Mask]:
    """Return, per thing received, which of those alike it is a copy of; per group, what tells; and what is no copy.

    Which one is 0 for the first that was sent, and so on. Time tells where those of a group were sent `APART_NS` from
    each other at least, and each received is nearest to one of them by far: that is the one. In all other groups each
    is taken for the nearest in time, as far as order allows and as all of the fewer side, sent or received, find one.
    No copy is in a group of which each received is nearest by far to another one, however close they were sent.

    Args:
        group: Group of those alike, of each thing sent, in ascending order.
        time_ns: When it was sent, in ascending order within its group.
        came_group: Group of each thing received, likewise.
        came_time_ns: When it was received, likewise.
    """
    groups = int(group.max(initial=-1)) + 1
    sent, received = (np.bincount(these, minlength=groups) for these in (group, came_group))
    place = np.zeros(len(came_group), dtype=np.int64)
    many = sent > 1
    told = np.ones(groups, dtype=np.bool_)
    chosen, left = many[came_group], many[group]
    if not chosen.any():
        return place, told, told
    offset_ns, known = _clock_offset_ns(group, time_ns, came_group, came_time_ns)
    group, time_ns = group[left], time_ns[left]
    came_group, came_time_ns = came_group[chosen], came_time_ns[chosen] - offset_ns
    sent, received = sent * many, received * many
    nearest = _nearest(group, time_ns, came_group, came_time_ns)
    index = (np.cumsum(sent) - sent)[came_group] + nearest
    apart_ns = _apart_ns(group, time_ns)[index]
    clear = _CLEAR * np.abs(came_time_ns - time_ns[index]) <= apart_ns
    told[came_group[~(known & clear & (apart_ns >= APART_NS))]] = False
    apart = np.ones(groups, dtype=np.bool_)
    apart[came_group[~clear | (np.diff(index, prepend=-1) == 0)]] = False

    rank = np.arange(len(came_group)) - (np.cumsum(received) - received)[came_group]
    spare = (sent - received)[came_group]
    # Where fewer came, some of those sent are skipped; where more came, some of those sent have several copies.
    sign = np.where(spare < 0, -1, 1)
    skipped = np.clip(sign * (nearest - rank), 0, np.abs(spare))
    high = came_group * (len(group) + len(came_group))
    in_order = rank + sign * (np.maximum.accumulate(skipped + high) - high)
    place[chosen] = np.where(told[came_group], nearest, in_order)
    return place, told, apart


def _apart_ns(group: Ints, time_ns: Ints) -> Ints:
    """Return how far each thing sent, its group and time in ascending order, is from the nearest of its group."""
    steps_ns = np.where(np.diff(group) == 0, np.diff(time_ns), np.iinfo(np.int64).max)
    edge = np.iinfo(np.int64).max
    apart_ns: Ints = np.minimum(np.append(edge, steps_ns), np.append(steps_ns, edge))
    return apart_ns


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


def _clock_offset_ns(group: Ints, time_ns: Ints, came_group: Ints, came_time_ns: Ints) -> tuple[int, bool]:
    """Return the receiver's clock minus the sender's, delay included, and whether that is known or a guess.

    It is known from what looks like nothing else; without any, from the groups of which all arrived.
    """
    groups = int(group.max()) + 1
    sent, received = (np.bincount(these, minlength=groups) for these in (group, came_group))
    first = np.diff(came_group, prepend=-1) != 0
    single = (sent == 1) & (received > 0)
    if single.any():
        return int(np.median(came_time_ns[first & single[came_group]] - time_ns[single[group]])), True
    even = sent == received
    if even.any():
        return int(np.median(came_time_ns[even[came_group]] - time_ns[even[group]])), True
    return int(came_time_ns.min() - time_ns.min()), False
