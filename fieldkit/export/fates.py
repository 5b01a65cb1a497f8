"""Fates of the packets in the captures of an attempt: which were lost, which are further copies."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.export.packets import NOT_KNOWN, MarkedPackets
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.transfers import strangers
from fieldkit.measure.transfers.match import Match, match
from fieldkit.measure.transfers.transfer import Transfer

# An IP packet's payload where no offload joined several: the MTU of Ethernet and Wi-Fi without the shortest header.
_LARGEST_PAYLOAD_BYTES: Final = 1480


def told(captures: Mapping[str, Capture], transfers: Iterable[Transfer]) -> Mapping[str, MarkedPackets]:
    """Return what became of the packets of each capture, as far as transfers that both ends captured tell.

    Args:
        captures: By file.
        transfers: What tells the packets of each.
    """
    found = {file: _unknown(capture.packets) for file, capture in captures.items()}
    ways: dict[tuple[str, str, str, str], list[Transfer]] = {}
    for transfer in transfers:
        here, there = transfer.captures
        if here is not None and there is not None and {here, there} <= captures.keys():
            ways.setdefault((here, there, transfer.sender_address, transfer.receiver_address), []).append(transfer)
    for (here, there, sender, receiver), alike in ways.items():
        matched = _matched(captures[here], captures[there], alike)
        if matched is None:
            continue
        sent, came = found[here], found[there]
        ours = sent.packets.are_from(sender) & sent.packets.are_to(receiver) & ~matched.doubtful
        sent.lost[ours] = ~matched.arrived[ours]
        in_doubt = np.append(matched.doubtful, False)[matched.sent_index]  # the last entry is that of match.NONE
        ours = came.packets.are_from(sender) & came.packets.are_to(receiver) & ~in_doubt
        came.copy[ours] = matched.duplicates[ours]
    return found


def _unknown(packets: Packets) -> MarkedPackets:
    lost, copy = np.full((2, len(packets)), NOT_KNOWN, np.int8)
    return MarkedPackets(packets, lost, copy)


def _matched(here: Capture, there: Capture, alike: Sequence[Transfer]) -> Match | None:
    """Return which packets of two captures are the same; None where that cannot be told of all transfers one way."""
    sent, received = here.packets, there.packets
    if here.damage or there.damage:
        return None
    is_tcp = any(transfer.protocol is Protocol.TCP for transfer in alike)
    if is_tcp and (_is_offloaded(sent) or _is_offloaded(received)):
        return None
    if any(strangers.reason(sent, received, transfer) for transfer in alike):
        return None
    try:
        return match(sent, received)
    except EvidenceError:
        return None


def _is_offloaded(captured: Packets) -> bool:
    """Return whether a capture has frames of several segments: those of one end are not those of the other."""
    return bool((captured.ip_payload_bytes > _LARGEST_PAYLOAD_BYTES).any())
