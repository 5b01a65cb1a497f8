"""Fates of the packets in the captures of an attempt: lost packets and duplicates."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.export.packets import NOT_KNOWN, MarkedPackets
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.transfers import altered_packets
from fieldkit.measure.transfers.match import Match, match
from fieldkit.measure.transfers.transfer_spec import Transfer

# Largest IP payload of a frame that offload did not join: the MTU of Ethernet and Wi-Fi without the shortest header.
_LARGEST_PAYLOAD_BYTES: Final = 1480


def packet_fates(captures: Mapping[str, Capture], transfers: Iterable[Transfer]) -> Mapping[str, MarkedPackets]:
    """Return the fates of the packets of each capture, as far as they belong to transfers captured at both ends.

    Args:
        captures: The captures by file.
        transfers: The packet filter of each transfer.
    """
    marked = {file: _unknown(capture.packets) for file, capture in captures.items()}
    by_path: dict[tuple[str, str, str, str], list[Transfer]] = {}
    for transfer in transfers:
        here, there = transfer.captures
        if here is not None and there is not None and {here, there} <= captures.keys():
            by_path.setdefault((here, there, transfer.sender_address, transfer.receiver_address), []).append(transfer)
    for (here, there, sender, receiver), same_path in by_path.items():
        matched = _matched(captures[here], captures[there], same_path)
        if matched is None:
            continue
        sent, received = marked[here], marked[there]
        forward = sent.packets.are_from(sender) & sent.packets.are_to(receiver) & ~matched.ambiguous
        sent.lost[forward] = ~matched.arrived[forward]
        is_ambiguous = np.append(matched.ambiguous, False)[matched.sent_index]  # the last entry is for match.NONE
        forward = received.packets.are_from(sender) & received.packets.are_to(receiver) & ~is_ambiguous
        received.copy[forward] = matched.duplicates[forward]
    return marked


def _unknown(packets: Packets) -> MarkedPackets:
    lost, copy = np.full((2, len(packets)), NOT_KNOWN, np.int8)
    return MarkedPackets(packets, lost, copy)


def _matched(here: Capture, there: Capture, same_path: Sequence[Transfer]) -> Match | None:
    """Return the matching packets of two captures, or None if they cannot be matched for all transfers of a path."""
    sent, received = here.packets, there.packets
    if here.damage or there.damage:
        return None
    is_tcp = any(transfer.protocol is Protocol.TCP for transfer in same_path)
    if is_tcp and (_is_offloaded(sent) or _is_offloaded(received)):
        return None
    if any(altered_packets.reason(sent, received, transfer) for transfer in same_path):
        return None
    try:
        return match(sent, received)
    except EvidenceError:
        return None


def _is_offloaded(captured: Packets) -> bool:
    """Return True if a capture has frames of several segments; they differ between the two ends."""
    return bool((captured.ip_payload_bytes > _LARGEST_PAYLOAD_BYTES).any())
