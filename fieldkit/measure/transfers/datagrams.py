"""Assignment of IP fragments to datagrams.

Only the first fragment of a datagram has ports. The others are assigned by IP id. The id has 16 bits and repeats in a
long transfer, or immediately in packets that are never fragmented (RFC 6864, section 4).
"""

from dataclasses import replace
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Ints, row_hashes
from fieldkit.measure.captures.packets import NO_PORT, Packets

NO_DATAGRAM: Final = -1


def datagrams(packets: Packets) -> tuple[Ints, Ints]:
    """Return the index of each datagram's first packet, and the datagram of each packet.

    A later fragment belongs to the latest first fragment with the same addresses and id, or to the next one if there
    is none before it. Its datagram is `NO_DATAGRAM` if there is none at all.
    """
    is_fragment = packets.more_fragments | (packets.fragment_offset > 0)
    # An unfragmented packet has no other fragments, whatever its id.
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
    """Return the packets with each later fragment's ports set to those of its first fragment, or `NO_PORT`."""
    first, datagram = datagrams(packets)
    sport, dport = (np.append(ports[first], NO_PORT)[datagram] for ports in (packets.sport, packets.dport))
    return replace(packets, sport=sport, dport=dport)
