"""Matching of received packets with sent packets by the fields that are equal at both ends.

Several packets can have equal headers: 16-bit IP ids repeat in a long transfer, or are always 0 in packets that are
never fragmented (RFC 6864, section 4), and a retransmission repeats its sequence numbers. Such packets are
distinguished by their content or by TCP time stamps. If these are equal too, they are distinguished by time, which
requires a minimum time between them. Packets that cannot be distinguished are ambiguous.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Ints, Keys, Mask, row_hashes
from fieldkit.measure.captures.headers import TCP
from fieldkit.measure.captures.packets import NO_STAMP, NOT_CAPTURED, RST, Packets
from fieldkit.measure.transfers import tcp_streams
from fieldkit.measure.transfers.tcp_streams import Pieces

NONE: Final = -1
"""Index that means "no packet"."""

MIN_SPACING_NS: Final = 200_000_000
"""Packets with equal keys can be distinguished by time if at least this time is between their times of sending.

It is the minimum retransmission timeout of Linux (TCP_RTO_MIN), after which TCP considers a packet lost.
"""

_CLEAR_FACTOR: Final = 4
"""An arrival is clearly nearest to a sent packet if the time between them is at most D divided by this factor. D is
the time between this sent packet and the nearest other sent packet with the same key.
"""


@dataclass(frozen=True, eq=False)
class Match:
    """Match between the n packets sent and the m packets received in two captures.

    Attributes:
        received_index: Index of the first copy of each sent packet among the received packets; `NONE` if it was lost.
            Shape (n,).
        sent_index: Index of the sent packet that each received packet is a copy of; `NONE` if the sender's capture
            has no such packet. Shape (m,).
        duplicates: Mask of received packets that are further copies of a packet that had arrived. Shape (m,).
        ambiguous: Mask of sent packets that cannot be distinguished from other packets: these are equal and were sent
            at nearly the same time, so the order of arrival is unknown. Such packets are matched in the order of
            sending. The number of arrived packets is the number sent or received, whichever is smaller. Shape (n,).
        possible_copy: Mask of received packets that are counted as arrived, but may be copies of another packet,
            because packets with the same key arrived at shorter intervals than they were sent. Shape (m,).
    """

    received_index: Ints
    sent_index: Ints
    duplicates: Mask
    ambiguous: Mask
    possible_copy: Mask

    @property
    def arrived(self) -> Mask:
        """Mask of the sent packets that arrived. Shape (n,)."""
        arrived: Mask = self.received_index != NONE
        return arrived


@dataclass(frozen=True, eq=False)
class Payload:
    """TCP payload of two captures, divided into comparable pieces.

    Attributes:
        sent: Sent pieces.
        received: Received pieces.
        match: Match between the pieces.
    """

    sent: Pieces
    received: Pieces
    match: Match


def match(sent: Packets, received: Packets) -> Match:
    """Match received packets with the sent packets that they are copies of.

    Packets are copies of each other if they have equal addresses, protocol, IP id, fragment offset, length, ports,
    and TCP numbers, flags and time stamp. If several packets have equal values, their content must also be equal.

    With segmentation offload, the two ends capture different TCP frames. A frame without an equal frame at the other
    end is matched with the frame that contains its first byte. It is a duplicate if all of its bytes are duplicates.

    Args:
        sent: Packets captured at the sender.
        received: Packets captured at the receiver; its clock may have any offset.

    Raises:
        EvidenceError: For the same reasons as `tcp_streams.cut`.
    """
    frames = _match_frames(sent, received)
    if not sent.tcp_payload_bytes.any() and not received.tcp_payload_bytes.any():
        return frames
    payload = _match_pieces(sent, received, frames)
    for from_pieces, to_pieces, index, piece_index in (
        (payload.sent, payload.received, frames.received_index, payload.match.received_index),
        (payload.received, payload.sent, frames.sent_index, payload.match.sent_index),
    ):
        # The match of a frame is that of its first piece; the index `NONE` (-1) selects the appended `NONE`.
        frame, first = np.unique(from_pieces.frame, return_index=True)
        index[frame] = np.append(to_pieces.frame, NONE)[piece_index[first]]
    frames.ambiguous[payload.sent.frame[payload.match.ambiguous]] = True
    # A frame is a duplicate if all of its pieces are duplicates.
    frames.duplicates[payload.received.frame] = True
    frames.duplicates[payload.received.frame[~payload.match.duplicates]] = False
    return frames


def match_payload(sent: Packets, received: Packets) -> Payload:
    """Match received TCP payload with the sent payload that it is a copy of.

    A piece matches a piece with the same bytes in a frame with the same time stamp. If frames have IP ids and there
    is an equal frame at the other end, a piece matches the piece in this frame. Frames without an equal frame were
    cut or joined by segmentation offload.

    Args:
        sent: Packets captured at the sender.
        received: Packets captured at the receiver; its clock may have any offset.

    Raises:
        EvidenceError: For the same reasons as `tcp_streams.cut`.
    """
    return _match_pieces(sent, received, _match_frames(sent, received))


def match_keys(
    key: Keys,
    time_ns: Ints,
    received_key: Keys,
    received_time_ns: Ints,
    *,
    contents: tuple[Ints, Ints] | None = None,
) -> Match:
    """Match sent and received items. Items with different keys are never copies of each other.

    Args:
        key: Key of each sent item. Shape (n,).
        time_ns: Time of sending of each item. Shape (n,).
        received_key: Key of each received item. Shape (m,).
        received_time_ns: Time of reception of each item, by any clock. Shape (m,).
        contents: Values that distinguish sent and received items with equal keys, `NOT_CAPTURED` for an unknown
            value; None if there are no such values.
    """
    sent_order, received_order = np.lexsort((time_ns, key)), np.lexsort((received_time_ns, received_key))
    keys, group = np.unique(key[sent_order], return_inverse=True)
    sent_count = np.bincount(group, minlength=len(keys))
    if contents is not None and (sent_count > 1).any():
        distinct_keys = _keys_with_content(keys[sent_count > 1], (key, received_key), contents)
        return match_keys(distinct_keys[0], time_ns, distinct_keys[1], received_time_ns)
    received_group = np.searchsorted(keys, received_key[received_order])
    has_match = (received_group < len(keys)) & (
        np.append(keys, np.uint64(0))[received_group] == received_key[received_order]
    )
    received_order, received_group = received_order[has_match], received_group[has_match]
    received_count = np.bincount(received_group, minlength=len(keys))

    position, is_clear, may_have_copies = assign(
        group, time_ns[sent_order], received_group, received_time_ns[received_order]
    )
    sent_index = np.full(len(received_key), NONE)
    sent_index[received_order] = sent_order[(np.cumsum(sent_count) - sent_count)[received_group] + position]
    received_index = np.full(len(key), NONE)
    # If an index occurs several times, numpy stores the last value: the earliest copy, because the order is reversed.
    received_index[sent_index[received_order[::-1]]] = received_order[::-1]
    duplicates: Mask = sent_index != NONE
    duplicates[received_index[received_index != NONE]] = False
    ambiguous = np.zeros(len(key), dtype=np.bool_)
    ambiguous[sent_order] = (~is_clear & (received_count > 0))[group]
    possible_copy = np.zeros(len(received_key), dtype=np.bool_)
    # If only one packet of a group arrived, it cannot be a copy of another one.
    possible_copy[received_order] = (~is_clear & may_have_copies & (received_count > 1))[received_group]
    possible_copy &= ~duplicates
    return Match(received_index, sent_index, duplicates, ambiguous, possible_copy)


def reordered(sent_index: Ints) -> Mask:
    """Return a mask of the items that arrived after an item that was sent later (RFC 4737, section 3).

    Args:
        sent_index: For each received item in the order of arrival, its position in the order of sending.
    """
    mask: Mask = sent_index < np.maximum.accumulate(sent_index)
    return mask


def usable_stamps(sent: Packets, received: Packets) -> tuple[Ints, Ints]:
    """Return the TCP time stamps of sent and received packets; `NO_STAMP` for connections without usable time stamps.

    If time stamps were negotiated, every frame except a reset has one (RFC 7323, section 3.2). The time stamps of a
    connection are not usable if a middlebox removed some of them, or if a capture truncated them.
    """
    lacks_stamp = [
        (packets.protocol == TCP) & (packets.tcp_stamp == NO_STAMP) & (packets.tcp_flags & RST == 0)
        for packets in (sent, received)
    ]
    if not any(mask.any() for mask in lacks_stamp):
        return sent.tcp_stamp, received.tcp_stamp
    connections = [connection_keys(packets) for packets in (sent, received)]
    connections_without_stamps = np.concatenate(
        [numbers[mask] for numbers, mask in zip(connections, lacks_stamp, strict=True)]
    )
    sent_stamps, received_stamps = (
        np.where(np.isin(numbers, connections_without_stamps), NO_STAMP, packets.tcp_stamp)
        for packets, numbers in zip((sent, received), connections, strict=True)
    )
    return sent_stamps, received_stamps


def connection_keys(packets: Packets) -> Keys:
    """Return a key of each packet, which is equal for packets with equal addresses and ports."""
    # Adding 1 makes `NO_PORT` (-1) 0, so that the two ports do not overlap.
    return row_hashes(*packets.src.T, *packets.dst.T, packets.sport + 1 << 20 | packets.dport + 1)


def _match_frames(sent: Packets, received: Packets) -> Match:
    """Match packets that are equal at both ends."""
    stamp, received_stamp = usable_stamps(sent, received)
    contents = sent.content, received.content
    return match_keys(
        _key(sent, stamp), sent.time_ns, _key(received, received_stamp), received.time_ns, contents=contents
    )


def _match_pieces(sent: Packets, received: Packets, frames: Match) -> Payload:
    """Match the pieces of payload, given the match of whole frames."""
    sent_pieces, received_pieces = tcp_streams.cut(sent, received)
    stamp, received_stamp = usable_stamps(sent, received)
    key = row_hashes(sent_pieces.range_id, stamp[sent_pieces.frame])
    received_key = row_hashes(received_pieces.range_id, received_stamp[received_pieces.frame])
    sent_frame, received_frame = _equal_frames(sent, received, frames)
    sent_frame, received_frame = sent_frame[sent_pieces.frame], received_frame[received_pieces.frame]
    # Without a time stamp, a received frame that offload cut or joined may be a part of any sent frame.
    may_be_part = (received_frame == 0) & (received_stamp[received_pieces.frame] == NO_STAMP)
    may_be_part |= ~np.isin(row_hashes(received_key, received_frame), row_hashes(key, sent_frame))
    received_frame = np.where(may_be_part, NOT_CAPTURED, received_frame)  # then `match_keys` does not compare frames
    pieces = match_keys(
        key,
        sent.time_ns[sent_pieces.frame],
        received_key,
        received.time_ns[received_pieces.frame],
        contents=(sent_frame, received_frame),
    )
    ambiguous = pieces.ambiguous | frames.ambiguous[sent_pieces.frame] & (sent_frame > 0)
    return Payload(sent_pieces, received_pieces, replace(pieces, ambiguous=ambiguous))


def _equal_frames(sent: Packets, received: Packets, frames: Match) -> tuple[Ints, Ints]:
    """Return a number for each sent and received frame that has an equal frame at the other end; 0 for other frames.

    Frames are equal only if they have the same IP id.
    """
    keys = [connection_keys(packets) for packets in (sent, received)]
    has_payload = sent.tcp_payload_bytes > 0
    _, first_of_id = np.unique(row_hashes(keys[0][has_payload], sent.ip_id[has_payload]), return_index=True)
    connections, id_count = np.unique(keys[0][has_payload][first_of_id], return_counts=True)
    # If all frames of a connection have the same id, any frame may be a part of another frame.
    has_ids, received_has_ids = (~np.isin(numbers, connections[id_count < 2]) for numbers in keys)
    sent_frame = np.where(frames.arrived & has_ids, np.arange(len(sent)), NONE) + 1
    received_frame = np.where(received_has_ids, frames.sent_index, NONE) + 1
    return sent_frame, received_frame


def _key(packets: Packets, stamp: Ints) -> Keys:
    """Return a key of each packet, which is equal for packets with equal fields.

    Two different packets have equal keys with a probability of at most about 2**-48.
    """
    ip = (packets.ip_id << 16 | packets.fragment_offset, packets.ip_payload_bytes << 8 | packets.protocol)
    tcp = (packets.tcp_seq << 32 | packets.tcp_ack, packets.tcp_flags << 33 | stamp + 1)
    key = connection_keys(packets)
    key = row_hashes(key, *ip, *tcp)
    # Most IP ids increase from packet to packet, and keys that increase with them are sorted faster.
    return packets.ip_id.astype(np.uint64) << np.uint64(48) | key >> np.uint64(16)


def _keys_with_content(ambiguous: Keys, keys: tuple[Keys, Keys], contents: tuple[Ints, Ints]) -> tuple[Keys, Keys]:
    """Return keys that also depend on the content if a key is ambiguous.

    Args:
        ambiguous: Keys that several packets have. The content of all packets with such a key must be known.
        keys: Keys of the sent and the received packets.
        contents: Contents of the sent and the received packets.
    """
    without_content = np.concatenate(
        [key[content == NOT_CAPTURED] for key, content in zip(keys, contents, strict=True)]
    )
    ambiguous = np.setdiff1d(ambiguous, without_content)
    sent_keys, received_keys = (
        np.where(np.isin(key, ambiguous), row_hashes(key, content), key)
        for key, content in zip(keys, contents, strict=True)
    )
    return sent_keys, received_keys


def assign(group: Ints, time_ns: Ints, received_group: Ints, received_time_ns: Ints) -> tuple[Ints, Mask, Mask]:
    """Assign received items to sent items within groups of items with equal keys.

    A group is clear if at least `MIN_SPACING_NS` is between its times of sending, and each received item is clearly
    nearest in time to one sent item. Each received item is then assigned to this sent item.

    In any other group, each received item is assigned to the nearest sent item that fulfils two conditions: the order
    of the items does not change, and as many items as possible are assigned to different sent items.

    If each received item is clearly nearest to a different sent item, the group contains no copies, even if the time
    between the sent items is short. Any other group may contain copies.

    Args:
        group: Group of each sent item, ascending.
        time_ns: Time of sending, ascending within a group.
        received_group: Group of each received item, ascending.
        received_time_ns: Time of reception, ascending within a group.

    Returns:
        Position of the sent item in its group for each received item, from 0 in the order of sending; mask of the
        groups that are clear; mask of the groups that may contain copies.
    """
    group_count = int(group.max(initial=-1)) + 1
    sent_count, received_count = (np.bincount(numbers, minlength=group_count) for numbers in (group, received_group))
    position = np.zeros(len(received_group), dtype=np.int64)
    has_several = sent_count > 1
    is_clear_group, may_have_copies = np.ones(group_count, dtype=np.bool_), np.zeros(group_count, dtype=np.bool_)
    is_undecided, in_several = has_several[received_group], has_several[group]
    if not is_undecided.any():
        return position, is_clear_group, may_have_copies
    offset_ns, is_offset_known = _clock_offset_ns(group, time_ns, received_group, received_time_ns)
    group, time_ns = group[in_several], time_ns[in_several]
    received_group, received_time_ns = received_group[is_undecided], received_time_ns[is_undecided] - offset_ns
    sent_count, received_count = sent_count * has_several, received_count * has_several
    nearest = _nearest(group, time_ns, received_group, received_time_ns)
    index = (np.cumsum(sent_count) - sent_count)[received_group] + nearest
    spacing_ns = _spacing_ns(group, time_ns)[index]
    is_nearest = _CLEAR_FACTOR * np.abs(received_time_ns - time_ns[index]) <= spacing_ns
    is_clear_group[received_group[~(is_offset_known & is_nearest & (spacing_ns >= MIN_SPACING_NS))]] = False
    may_have_copies[received_group[~is_nearest | (np.diff(index, prepend=-1) == 0)]] = True

    order = np.arange(len(received_group)) - (np.cumsum(received_count) - received_count)[received_group]
    surplus = (sent_count - received_count)[received_group]
    # If fewer items were received than sent, some sent items are skipped. If more were received, some sent items have
    # several copies.
    sign = np.where(surplus < 0, -1, 1)
    skipped = np.clip(sign * (nearest - order), 0, np.abs(surplus))
    group_base = received_group * (len(group) + len(received_group))
    in_order = order + sign * (np.maximum.accumulate(skipped + group_base) - group_base)
    position[is_undecided] = np.where(is_clear_group[received_group], nearest, in_order)
    return position, is_clear_group, may_have_copies


def _spacing_ns(group: Ints, time_ns: Ints) -> Ints:
    """Return the time between each sent item and the nearest other item of its group.

    The items must be in the order of groups and times.
    """
    steps_ns = np.where(np.diff(group) == 0, np.diff(time_ns), np.iinfo(np.int64).max)
    edge = np.iinfo(np.int64).max
    spacing_ns: Ints = np.minimum(np.append(edge, steps_ns), np.append(steps_ns, edge))
    return spacing_ns


def _nearest(group: Ints, time_ns: Ints, received_group: Ints, received_time_ns: Ints) -> Ints:
    """Return the position in the group of the sent item that is nearest in time to each received item."""
    sent = np.bincount(group)
    order = np.lexsort((np.concatenate((time_ns, received_time_ns)), np.concatenate((group, received_group))))
    is_sent = order < len(group)
    first, last = (np.cumsum(sent) - sent)[received_group], np.cumsum(sent)[received_group] - 1
    after = np.cumsum(is_sent)[~is_sent]  # number of sent items that precede each received item in this order
    earlier, later = np.maximum(after - 1, first), np.minimum(after, last)
    nearest: Ints = (
        np.where(received_time_ns - time_ns[earlier] < time_ns[later] - received_time_ns, earlier, later) - first
    )
    return nearest


def _clock_offset_ns(group: Ints, time_ns: Ints, received_group: Ints, received_time_ns: Ints) -> tuple[int, bool]:
    """Return the receiver's clock minus the sender's, including the delay, and True if the value is reliable.

    It is computed from items with a unique key or, if there are none, from groups whose items all arrived. Otherwise,
    it is a rough estimate.
    """
    group_count = int(group.max()) + 1
    sent, received = (np.bincount(numbers, minlength=group_count) for numbers in (group, received_group))
    first = np.diff(received_group, prepend=-1) != 0
    single = (sent == 1) & (received > 0)
    if single.any():
        return int(np.median(received_time_ns[first & single[received_group]] - time_ns[single[group]])), True
    all_arrived = sent == received
    if all_arrived.any():
        return int(np.median(received_time_ns[all_arrived[received_group]] - time_ns[all_arrived[group]])), True
    return int(received_time_ns.min() - time_ns.min()), False
