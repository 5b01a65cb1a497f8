"""Contradictions between a file that came by UDP and the datagrams in both captures.

netcat writes the payload of each datagram that its kernel delivers, in the order of delivery. So what was received is
a sequence of blocks of what was sent: those of the datagrams that arrived whole, less those that the kernel refused.
Legitimate losses behind the capture have a counter: a full socket buffer or a wrong checksum (InErrors), a failed
reassembly (ReasmFails), a listener that had ended (NoPorts).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from mmap import mmap
from typing import Final

import numpy as np

from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.units import format_count
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES, Packets
from fieldkit.measure.evidence import reading
from fieldkit.measure.transfers.transfer import Transfer

CROSS_CHECK: Final = CrossCheck(
    "file that came by UDP",
    ("received_bytes", "file_loss", "hash_match"),
    "`recv.bag`",
    ("both captures: datagrams that arrived whole, in their order", "`scan.bag`: their content"),
    "datagrams that the receiver's kernel counts as refused (InErrors, ReasmFails, NoPorts); all that follow, if the "
    "listener was ended at its limit",
)


@dataclass(frozen=True)
class _Block:
    """Payload of a datagram that arrived: a part of the file that was sent."""

    start: int
    stop: int


def find(
    evidence: AttemptEvidence, transfer: Transfer, sender: Packets, receiver: Packets, *, cut: bool
) -> Iterator[str]:
    """Yield why the file is not what arrived; nothing where captures do not show which datagram is which.

    Args:
        evidence: What the attempt left.
        transfer: The transfer, by UDP.
        sender: Packets of the sender's whole capture.
        receiver: Packets of the receiver's whole capture.
        cut: Whether the listener was ended before it was done.
    """
    sent_file, received_file = (
        evidence.read_or_none(reading.mapped, name) for name in (transfer.sent_file, transfer.received_file)
    )
    if sent_file is None or received_file is None:
        return
    arrived = _blocks(transfer.forward(sender), transfer.forward(receiver), transfer.port, len(sent_file))
    if arrived is None:
        return
    blocks, once = arrived
    counters = evidence.counters(transfer.destination)
    lost = (counters.udp_undelivered, counters.reassembly_failures or 0, counters.udp_no_ports or 0)
    refused = None if cut or lost[0] is None else sum(count or 0 for count in lost)
    came = f"{format_count(len(blocks), 'datagram')} arrived whole"
    if not once:
        # A copy may be delivered too: sizes compare, places in the file do not.
        least_bytes = sum(sorted(block.stop - block.start for block in blocks)[: len(blocks) - (refused or 0)])
        if refused is not None and len(received_file) < least_bytes:
            yield f"{came}, and {transfer.received_file} has {len(received_file)} bytes of {least_bytes}"
        return
    at, remaining = 0, list(blocks)
    while at < len(received_file):
        # Two processors may deliver in another order than they captured.
        fits = (_at(received_file, at, sent_file, block, cut) for block in remaining)
        index = next((place for place, fit in enumerate(fits) if fit), -1)
        if index < 0:
            break
        block = remaining.pop(index)
        at = min(at + block.stop - block.start, len(received_file))
    skipped = len(remaining)
    if at < len(received_file):
        yield f"{transfer.received_file} has other content than {transfer.sent_file} from byte {at} on: {came}"
    elif refused is not None and skipped > refused:
        what = f"{came}, {transfer.received_file} lacks {skipped} of them"
        yield f"{what}, and the kernel of the {transfer.destination} refused {refused}"


def _at(received_file: bytes | mmap, at: int, sent_file: bytes | mmap, block: _Block, cut: bool) -> bool:
    """Return whether a block is at this place in the received file; the last one may be cut there."""
    size = block.stop - block.start
    if cut:
        size = min(size, len(received_file) - at)
    return received_file[at : at + size] == sent_file[block.start : block.start + size]


def _blocks(sent: Packets, received: Packets, port: int, size_bytes: int) -> tuple[Sequence[_Block], bool] | None:
    """Return the datagrams that arrived whole, in the order in which they became so.

    Returns:
        The datagrams, and whether no fragment arrived twice; None if it is not certain which datagram is which.
    """
    first = sent.where(sent.dport == port)
    sizes = first.udp_bytes - UDP_HEADER_BYTES
    stops = np.cumsum(sizes)
    unique = len(np.unique(first.ip_id)) == len(first)
    if not len(first) or not unique or stops[-1] != size_bytes:
        return None
    place = {int(ip_id): index for index, ip_id in enumerate(first.ip_id)}
    own = received.where(np.isin(received.ip_id, first.ip_id))
    both = (own, sent.where(np.isin(sent.ip_id, first.ip_id)))
    # A later fragment of another flow with the same id cannot be distinguished from one of these.
    strange = np.concatenate([(packets.fragment_offset == 0) & (packets.dport != port) for packets in both])
    if strange.any():
        return None
    _, earliest = np.unique(np.stack((own.ip_id, own.fragment_offset)), axis=1, return_index=True)
    once = len(earliest) == len(own)
    own = own.where(np.sort(earliest))
    order = np.argsort(own.ip_id, kind="stable")
    ids, begins = np.unique(own.ip_id[order], return_index=True)
    if not len(ids):
        return [], True
    held = np.add.reduceat(own.ip_payload_bytes[order], begins)
    whole_ns = np.maximum.reduceat(own.time_ns[order], begins)
    index = np.array([place[int(ip_id)] for ip_id in ids])
    whole = held == first.udp_bytes[index]
    arrival = np.argsort(whole_ns[whole], kind="stable")
    came = index[whole][arrival]
    return [_Block(int(stops[at] - sizes[at]), int(stops[at])) for at in came], once
