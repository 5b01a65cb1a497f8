"""Packets of a transfer that reached the receiver as others than those that were sent.

A router that translates an address or a port, gives packets new ids or sequence numbers, or cuts them anew, makes
others of them: nothing in both captures is then equal, and all would count as lost. In captures that are whole the
receiver has no packet that the sender does not have.
"""

from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Keys, Mask, mixed
from fieldkit.measure.captures.ip import TCP, written
from fieldkit.measure.captures.packets import NO_PORT, SYN, Packets
from fieldkit.measure.transfers.match import connection, stamps
from fieldkit.measure.transfers.transfer import Transfer

MOST: Final = 0.05
"""Share of what arrived that the sender's capture may lack: a straggler of something earlier is no router."""

_STRAGGLERS: Final = 3
"""A connection that broke off before may still send so many packets, from its own port, to the transfer's."""

_AT_ONCE_NS: Final = 1_000_000
"""Nothing sends a packet again within this time under the same IP id."""


def reason(sender: Packets, receiver: Packets, transfer: Transfer) -> str | None:
    """Return why the packets of two whole captures do not compare, None where they do.

    Args:
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        transfer: What tells its packets, of which those count that have a port.
    """
    here, there = transfer.forward(sender), transfer.forward(receiver)
    sent, came = (packets.where(packets.dport == transfer.port) for packets in (here, there))
    if why := _unfit(here, there, sent):
        return why
    if not len(sent):
        return None
    has_port = np.zeros(1 << 16, dtype=np.bool_)
    has_port[sent.sport] = True
    own, renamed = came.where(has_port[came.sport]), came.where(~has_port[came.sport])
    alike = np.isin(_anonymous(renamed), _anonymous(sent))
    earlier = alike.sum() <= MOST * len(renamed)
    if earlier and len(renamed) > _STRAGGLERS and not len(own):
        return (
            f"none of its {len(sent)} packets reached the receiver, and {len(renamed)} others did {_most(renamed)}:"
            " packets of an earlier attempt were still on the way, or a port is translated and all else changed"
        )
    if earlier or len(renamed) <= _STRAGGLERS:
        renamed = renamed.where(alike)
    foreign = Packets.joined((renamed, _readdressed(sender, receiver, sent, own, transfer)))
    changed = int((~_known(sent, own)).sum())
    arrived = len(own) + len(foreign)
    if len(foreign) > MOST * arrived:
        return (
            f"{len(foreign)} of its {arrived} packets left {_most(sent)} and reached the receiver {_most(foreign)}:"
            " an address or a port is translated on the way"
        )
    if changed > MOST * arrived:
        return (
            f"{changed} of its {arrived} packets at the receiver are not among those that the sender captured:"
            " they are changed on the way, or the sender's capture lacks them"
        )
    return None


def _unfit(left: Packets, arrived: Packets, sent: Packets) -> str | None:
    """Return why one capture by itself compares with none, None where each does."""
    for end, packets in (("sender", left), ("receiver", arrived)):
        if cut := _cut(packets):
            return f"{cut} packets in the {end}'s capture were cut off before the end of their TCP or UDP header"
    if (twice := _twice(sent)) > MOST * len(sent):
        what = f"{twice} of its {len(sent)} packets in the sender's capture are there twice"
        return f"{what}, as from two interfaces that they pass"
    return None


def _cut(packets: Packets) -> int:
    """Return how many packets were not kept up to the end of their TCP or UDP header: they seem to be another's."""
    last_field = np.where(packets.protocol == TCP, packets.tcp_flags, packets.udp_bytes)
    return int(((packets.fragment_offset == 0) & (last_field == 0)).sum())


def _twice(sent: Packets) -> int:
    """Return how many packets follow one of the same IP id and all else within `_AT_ONCE_NS`, two of each in all."""
    named = sent.where(sent.ip_id != 0)
    key = mixed(connection(named), _datagram(named), named.tcp_seq)
    order = np.lexsort((named.time_ns, key))
    key, time_ns = key[order], named.time_ns[order]
    edges = np.flatnonzero(np.append(True, key[1:] != key[:-1])) if len(key) else key.astype(np.int64)
    pairs = edges[np.diff(np.append(edges, len(key))) == 2]
    return int((time_ns[pairs + 1] - time_ns[pairs] < _AT_ONCE_NS).sum())


def _readdressed(sender: Packets, receiver: Packets, sent: Packets, own: Packets, transfer: Transfer) -> Packets:
    """Return packets of another address that equal packets sent in all else, and did not arrive as these."""
    # One end of the transfer is still theirs.
    from_it, to_it = receiver.are_from(transfer.sender_address), receiver.are_to(transfer.receiver_address)
    others = (from_it | to_it | (receiver.dport == transfer.port)) & (receiver.sport != NO_PORT)
    others &= (receiver.protocol == sent.protocol[0]) & ~(from_it & to_it & (receiver.dport == transfer.port))
    found = receiver.where(others)
    if not len(found):
        return found
    found = found.where(~np.isin(connection(found), connection(sender)))
    as_sent, as_own, anonymous = (_anonymous(packets) for packets in (sent, own, found))
    return found.where(np.isin(anonymous, as_sent) & ~np.isin(anonymous, as_own))


def _known(sent: Packets, own: Packets) -> Mask:
    """Return which packets of the transfer's own addresses and ports were sent."""
    if sent.protocol[0] != TCP:
        return np.isin(_datagram(own), _datagram(sent))
    # Offload cuts and joins frames; it leaves their stamps alone, and the range of their numbers.
    left, came = stamps(sent, own)
    base = np.zeros(1 << 16, dtype=np.int64)
    # Of several values for one place numpy keeps the last, here the earliest.
    base[sent.sport[::-1]] = sent.tcp_seq[::-1]
    begun = np.zeros(1 << 16, dtype=np.bool_)
    begun[sent.sport[sent.tcp_flags & SYN != 0]] = True
    # SYN and FIN take a number each.
    longest = np.bincount(sent.sport, weights=sent.tcp_payload_bytes, minlength=1 << 16) + 2
    inside = (own.tcp_seq - base[own.sport]) % 2**32 <= longest[own.sport]
    return np.isin(came, left) & (inside | ~begun[own.sport])


def _anonymous(packets: Packets) -> Keys:
    """Return what the translation of an address or a port leaves alone."""
    if len(packets) and packets.protocol[0] == TCP:
        # Frames of both ends differ where offload cuts and joins them.
        return mixed(packets.tcp_seq, packets.tcp_flags & SYN)
    return _datagram(packets)


def _datagram(packets: Packets) -> Keys:
    return mixed(packets.ip_payload_bytes, packets.ip_id, packets.fragment_offset)


def _most(packets: Packets) -> str:
    """Return the addresses and ports of most of these packets."""
    _, first, count = np.unique(connection(packets), return_index=True, return_counts=True)
    one = packets.where(first[[count.argmax()]])
    ends = ((one.src, one.sport), (one.dst, one.dport))
    return "as " + " > ".join(f"{written(*halves[0].tolist())}:{port[0]}" for halves, port in ends)
