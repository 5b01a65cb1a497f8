"""Packets of a transfer that reached the receiver as others than those that were sent.

A router that translates an address or a port, gives packets new ids or sequence numbers, or cuts them anew, makes
others of them: nothing in both captures is then equal, and all would count as lost. In captures that are whole the
receiver has no packet that the sender does not have.
"""

from ipaddress import IPv6Address
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Keys, Mask, mixed
from fieldkit.measure.captures.ip import TCP
from fieldkit.measure.captures.packets import NO_PORT, SYN, Packets
from fieldkit.measure.transfers.match import connection, stamps
from fieldkit.measure.transfers.transfer import Transfer

MOST: Final = 0.05
"""So many of what arrived may be unknown to the sender's capture: a straggler of something earlier is no router."""


def reason(sender: Packets, receiver: Packets, transfer: Transfer) -> str | None:
    """Return why the packets of two whole captures do not compare, None where they do.

    Args:
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        transfer: What tells its packets, of which those count that have a port.
    """
    sent = transfer.forward(sender)
    sent = sent.where(sent.dport == transfer.port)
    if not len(sent):
        return None
    came = receiver.where((receiver.protocol == sent.protocol[0]) & (receiver.sport != NO_PORT))
    own = np.isin(connection(came), connection(sent))
    known = _known(sent, came.where(own))
    foreign = came.where(~own & _to_the_transfer(came, transfer) & ~np.isin(connection(came), connection(sender)))
    if len(foreign):
        foreign = foreign.where(_renamed(sent, came.where(own), foreign))
    arrived, changed = int(own.sum()) + len(foreign), int((~known).sum())
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


def _to_the_transfer(packets: Packets, transfer: Transfer) -> Mask:
    """Return which packets still have one end of the transfer."""
    ours: Mask = (
        (packets.dport == transfer.port)
        | packets.are_from(transfer.sender_address)
        | packets.are_to(transfer.receiver_address)
    )
    return ours


def _known(sent: Packets, came: Packets) -> Mask:
    """Return which packets of the transfer's own addresses and ports were sent."""
    if not len(came) or sent.protocol[0] != TCP:
        return np.isin(_datagram(came), _datagram(sent))
    # Offload cuts and joins frames; it leaves their stamps alone, and the range of their numbers.
    begun = sent.tcp_flags & SYN != 0
    left, arrived = stamps(sent, came)
    begun_of = np.isin(connection(came), connection(sent)[begun])
    stamped = np.isin(mixed(connection(came), arrived), mixed(connection(sent), left))
    known: Mask = ~begun_of | stamped & _in_range(sent, came)
    return known


def _in_range(sent: Packets, came: Packets) -> Mask:
    """Return which TCP frames begin within what their connection sent."""
    connections, first, number = np.unique(connection(sent), return_index=True, return_inverse=True)
    base = sent.tcp_seq[first]
    # No longer than all of its payload, and SYN and FIN take a number each.
    furthest = np.bincount(number, weights=sent.tcp_payload_bytes)
    place = np.searchsorted(connections, connection(came))
    begins = (came.tcp_seq - base[place]) % 2**32
    inside: Mask = begins <= furthest[place] + 2
    return inside


def _renamed(sent: Packets, own: Packets, foreign: Packets) -> Mask:
    """Return which packets of other addresses or ports equal packets sent in all else, and did not arrive as these.

    One with the transfer's own addresses and port, and another source port, can be nothing else.
    """
    as_sent, as_own, renamed_as = (_anonymous(one) for one in (sent, own, foreign))
    same_ends = (
        (foreign.src == sent.src[0]).all(axis=1)
        & (foreign.dst == sent.dst[0]).all(axis=1)
        & (foreign.dport == sent.dport[0])
    )
    renamed: Mask = same_ends | np.isin(renamed_as, as_sent) & ~np.isin(renamed_as, as_own)
    return renamed


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
    return "as " + " > ".join(f"{_address(*halves[0].tolist())}:{port[0]}" for halves, port in ends)


def _address(upper: int, lower: int) -> str:
    found = IPv6Address(upper << 64 | lower)
    return str(found.ipv4_mapped or found)
