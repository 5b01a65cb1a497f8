"""Packets of a transfer that were altered between sender and receiver.

A router alters packets if it translates addresses or ports (NAT), changes ids or sequence numbers, or fragments
packets differently. Such packets match no packet in the sender's capture and would be counted as lost. If the
captures are complete and no packet is altered, every received packet of the transfer is in the sender's capture.

A router recomputes the checksum of the IPv4 header. A wrong checksum therefore shows that the header was altered on a
link or in the file. Such a packet cannot be assigned to a flow, so it would be counted as lost or as not sent.
Packets of other flows, which tcpdump captures before its filter is attached, have correct checksums.
"""

from typing import Final

import numpy as np

from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Keys, Mask, row_hashes
from fieldkit.measure.captures.headers import TCP, address_text
from fieldkit.measure.captures.packets import NO_PORT, SYN, Packets
from fieldkit.measure.transfers.match import connection_keys, usable_stamps
from fieldkit.measure.transfers.transfer_spec import Transfer

MAX_ALTERED_SHARE: Final = 0.05
"""Maximum share of received packets that are not in the sender's capture. A few may be from earlier traffic."""

_MAX_LATE_PACKETS: Final = 3
"""Maximum number of packets that an aborted earlier connection may still send to the port of the transfer."""

_DUPLICATE_NS: Final = 1_000_000
"""Two packets with the same IP id within this time are one packet that was captured twice, not a retransmission."""


def header_problem(packets: Packets) -> str | None:
    """Return a description of the altered packets, or None if all checksums of IPv4 headers are correct."""
    if not (wrong := int(packets.wrong_checksum.sum())):
        return None
    return (
        f"{wrong} of {len(packets)} packets have a wrong IPv4 header checksum:"
        " they were altered on a link or in the file"
    )


def incomparability_reason(sender: Packets, receiver: Packets, transfer: Transfer) -> str | None:
    """Return the reason why two complete captures cannot be compared.

    None if they can be compared, or if the sender's capture has no packet of the transfer.

    The reason continues a sentence about the transfer, to which the word `its` in the reason refers.

    Args:
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        transfer: Identifies the packets of the transfer; only packets with a port are used.
    """
    forward_sent, forward_received = transfer.forward(sender), transfer.forward(receiver)
    sent, received = (packets.where(packets.dport == transfer.port) for packets in (forward_sent, forward_received))
    if problem := _capture_problem(forward_sent, forward_received, sent):
        return problem
    if not len(sent):
        return None
    has_port = np.zeros(1 << 16, dtype=np.bool_)
    has_port[sent.sport] = True
    from_same_port, from_other_ports = (
        received.where(has_port[received.sport]),
        received.where(~has_port[received.sport]),
    )
    # Packets from other source ports are earlier traffic if hardly any of them equals a sent packet.
    matches_sent = np.isin(_address_free_keys(from_other_ports), _address_free_keys(sent))
    is_earlier_traffic = matches_sent.sum() <= MAX_ALTERED_SHARE * len(from_other_ports)
    if is_earlier_traffic and len(from_other_ports) > _MAX_LATE_PACKETS and not len(from_same_port):
        return (
            f"none of its {len(sent)} packets reached the receiver, but {len(from_other_ports)} other packets did,"
            f" {_most_common_ends(from_other_ports)}: packets of an earlier attempt were still in transit,"
            " or a router changed the port and other fields"
        )
    if is_earlier_traffic or len(from_other_ports) <= _MAX_LATE_PACKETS:
        from_other_ports = from_other_ports.where(matches_sent)
    altered = Packets.concatenated(
        (from_other_ports, _with_other_address(sender, receiver, sent, from_same_port, transfer))
    )
    changed_count = int((~_were_sent(sent, from_same_port)).sum())
    arrived_count = len(from_same_port) + len(altered)
    if len(altered) > MAX_ALTERED_SHARE * arrived_count:
        return (
            f"{len(altered)} of its {arrived_count} packets left {_most_common_ends(sent)} and reached the receiver"
            f" {_most_common_ends(altered)}: a router on the path translates an address or a port"
        )
    if changed_count > MAX_ALTERED_SHARE * arrived_count:
        return (
            f"{changed_count} of its {arrived_count} packets at the receiver are not in the sender's capture:"
            " they were changed on the path, or the sender's capture is incomplete"
        )
    return None


def _capture_problem(sent_forward: Packets, received_forward: Packets, sent: Packets) -> str | None:
    """Return the reason why one of the captures cannot be used for any comparison, or None."""
    for end, packets in (("sender", sent_forward), ("receiver", received_forward)):
        if truncated := _truncated_count(packets):
            packets_text = format_count(truncated, "packet")
            return f"the {end}'s capture has {packets_text} truncated in the TCP or UDP header"
    if (duplicates := _duplicate_count(sent)) > MAX_ALTERED_SHARE * len(sent):
        duplicates_text = f"{duplicates} of its {len(sent)} packets in the sender's capture occur twice"
        return f"{duplicates_text}, as if they were captured on two interfaces"
    return None


def _truncated_count(packets: Packets) -> int:
    """Return the number of packets that were truncated before the end of their TCP or UDP header."""
    # In a complete header, this field is above 0.
    last_field = np.where(packets.protocol == TCP, packets.tcp_flags, packets.udp_bytes)
    return int(((packets.fragment_offset == 0) & (last_field == 0)).sum())


def _duplicate_count(sent: Packets) -> int:
    """Return the number of packets that occur exactly twice, with the same IP id, within `_DUPLICATE_NS`."""
    with_id = sent.where(sent.ip_id != 0)
    key = row_hashes(connection_keys(with_id), _ip_keys(with_id), with_id.tcp_seq)
    order = np.lexsort((with_id.time_ns, key))
    key, time_ns = key[order], with_id.time_ns[order]
    group_starts = np.flatnonzero(np.append(True, key[1:] != key[:-1])) if len(key) else key.astype(np.int64)
    pairs = group_starts[np.diff(np.append(group_starts, len(key))) == 2]
    return int((time_ns[pairs + 1] - time_ns[pairs] < _DUPLICATE_NS).sum())


def _with_other_address(
    sender: Packets, receiver: Packets, sent: Packets, from_same_port: Packets, transfer: Transfer
) -> Packets:
    """Return the received packets that differ from a sent packet only in an address or a port.

    Sent packets that arrived unaltered are not compared.
    """
    # A candidate must have the address of at least one end of the transfer, or its port, but not all three.
    is_from_sender, is_to_receiver = (
        receiver.are_from(transfer.sender_address),
        receiver.are_to(transfer.receiver_address),
    )
    is_candidate = (is_from_sender | is_to_receiver | (receiver.dport == transfer.port)) & (receiver.sport != NO_PORT)
    is_candidate &= (receiver.protocol == sent.protocol[0]) & ~(
        is_from_sender & is_to_receiver & (receiver.dport == transfer.port)
    )
    candidates = receiver.where(is_candidate)
    if not len(candidates):
        return candidates
    # Packets of other connections that are in the sender's capture were not altered.
    candidates = candidates.where(~np.isin(connection_keys(candidates), connection_keys(sender)))
    sent_keys, unaltered_keys, candidate_keys = (
        _address_free_keys(packets) for packets in (sent, from_same_port, candidates)
    )
    return candidates.where(np.isin(candidate_keys, sent_keys) & ~np.isin(candidate_keys, unaltered_keys))


def _were_sent(sent: Packets, received: Packets) -> Mask:
    """Return a mask of the received packets that are in the sender's capture.

    All packets must have the addresses and ports of the transfer.
    """
    if sent.protocol[0] != TCP:
        return np.isin(_ip_keys(received), _ip_keys(sent))
    # Offload cuts and joins frames, but does not change their time stamps and the range of sequence numbers.
    sent_stamps, received_stamps = usable_stamps(sent, received)
    base = np.zeros(1 << 16, dtype=np.int64)
    # If an index occurs several times, numpy stores the last value: the first frame, because the order is reversed.
    base[sent.sport[::-1]] = sent.tcp_seq[::-1]
    has_syn = np.zeros(1 << 16, dtype=np.bool_)
    has_syn[sent.sport[sent.tcp_flags & SYN != 0]] = True
    # SYN and FIN consume one sequence number each.
    stream_bytes = np.bincount(sent.sport, weights=sent.tcp_payload_bytes, minlength=1 << 16) + 2
    is_in_stream = (received.tcp_seq - base[received.sport]) % 2**32 <= stream_bytes[received.sport]
    return np.isin(received_stamps, sent_stamps) & (is_in_stream | ~has_syn[received.sport])


def _address_free_keys(packets: Packets) -> Keys:
    """Return a key of each packet that does not depend on its addresses and ports."""
    if len(packets) and packets.protocol[0] == TCP:
        # Offload cuts and joins frames, so their lengths may differ.
        return row_hashes(packets.tcp_seq, packets.tcp_flags & SYN)
    return _ip_keys(packets)


def _ip_keys(packets: Packets) -> Keys:
    return row_hashes(packets.ip_payload_bytes, packets.ip_id, packets.fragment_offset)


def _most_common_ends(packets: Packets) -> str:
    """Return the most common addresses and ports of the packets, such as `as 10.0.0.1:1000 > 10.0.0.2:2000`."""
    _, first, count = np.unique(connection_keys(packets), return_index=True, return_counts=True)
    packet = packets.where(first[[count.argmax()]])
    ends = ((packet.src, packet.sport), (packet.dst, packet.dport))
    return "as " + " > ".join(f"{address_text(*halves[0].tolist())}:{port[0]}" for halves, port in ends)
