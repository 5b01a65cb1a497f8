"""Contradictions between a file received over UDP and the datagrams in both captures.

netcat writes the payload of each datagram that its kernel delivers, in the order of delivery. The received file is
therefore a sequence of blocks of the sent file: the payloads of the datagrams that arrived completely and were not
dropped by the kernel. The kernel counts the datagrams that it drops after the capture because of a full socket buffer
or a wrong checksum (InErrors), a failed reassembly (ReasmFails), or a listener that had exited (NoPorts).
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
from fieldkit.measure.transfers.transfer_spec import Transfer

CROSS_CHECK: Final = CrossCheck(
    quantity="file received over UDP",
    columns=("received_bytes", "file_loss", "hash_match"),
    source="`recv.bag`",
    against=("both captures: datagrams that arrived completely, in their order", "`scan.bag`: their content"),
    tolerance=(
        "the file may lack datagrams that the receiver's kernel counts as dropped (InErrors, ReasmFails, NoPorts), "
        "and the last ones if the listener was stopped at its time limit"
    ),
)


@dataclass(frozen=True)
class _Block:
    """Payload of a datagram that arrived, as a range of the sent file."""

    start: int
    stop: int


def find_contradictions(
    evidence: AttemptEvidence, transfer: Transfer, sender: Packets, receiver: Packets, *, was_stopped: bool
) -> Iterator[str]:
    """Yield contradictions between the received file and the datagrams that arrived.

    There are none if a file is missing, or if the datagrams cannot be identified in the captures.

    Args:
        evidence: The attempt's evidence.
        transfer: The transfer, over UDP.
        sender: Packets of the sender's undamaged capture.
        receiver: Packets of the receiver's undamaged capture.
        was_stopped: True if the listener, the receiving netcat, was stopped before it had finished.
    """
    sent_file, received_file = (
        evidence.read_or_none(reading.mapped, name) for name in (transfer.sent_file, transfer.received_file)
    )
    if sent_file is None or received_file is None:
        return
    arrival = _blocks(transfer.forward(sender), transfer.forward(receiver), transfer.port, len(sent_file))
    if arrival is None:
        return
    blocks, has_copies = arrival
    counters = evidence.counters(transfer.destination)
    # `dropped` is None if the number of datagrams that did not reach the file is unknown.
    dropped = None
    if not was_stopped and counters.udp_undelivered is not None:
        dropped = counters.udp_undelivered + (counters.reassembly_failures or 0) + (counters.udp_no_ports or 0)
    arrived_text = f"{format_count(len(blocks), 'datagram')} arrived completely"
    if has_copies:
        # Copies may also be delivered, so only sizes are compared, not positions in the file.
        min_bytes = sum(sorted(block.stop - block.start for block in blocks)[: len(blocks) - (dropped or 0)])
        if dropped is not None and len(received_file) < min_bytes:
            size_text = f"{transfer.received_file} has {len(received_file)} bytes instead of {min_bytes} or more"
            yield f"{arrived_text}, but {size_text}"
        return
    at, remaining = 0, list(blocks)
    while at < len(received_file):
        # On a robot with several processors, the order of delivery may differ from the order in the capture.
        matches = (_is_block_at(received_file, at, sent_file, block, was_stopped) for block in remaining)
        index = next((position for position, is_match in enumerate(matches) if is_match), -1)
        if index < 0:
            break
        block = remaining.pop(index)
        at = min(at + block.stop - block.start, len(received_file))
    skipped = len(remaining)
    if at < len(received_file):
        difference = f"{transfer.received_file} differs from {transfer.sent_file} from byte {at} on"
        yield f"{difference}, although {arrived_text}"
    elif dropped is not None and skipped > dropped:
        missing_text = f"{arrived_text}, but {transfer.received_file} lacks {skipped} of them"
        yield f"{missing_text}, and the kernel of the {transfer.destination} dropped {dropped}"


def _is_block_at(
    received_file: bytes | mmap, at: int, sent_file: bytes | mmap, block: _Block, was_stopped: bool
) -> bool:
    """Return True if the received file contains the block at this position.

    The last block may be incomplete if the listener was stopped.
    """
    size = block.stop - block.start
    if was_stopped:
        size = min(size, len(received_file) - at)
    return received_file[at : at + size] == sent_file[block.start : block.start + size]


def _blocks(sent: Packets, received: Packets, port: int, size_bytes: int) -> tuple[Sequence[_Block], bool] | None:
    """Return the datagrams that arrived completely, in the order of arrival, and True if a fragment arrived twice.

    Return None if the datagrams cannot be identified: the sent ids are not unique, another flow uses one of them, or
    the sender's capture does not contain all bytes of the file.
    """
    first = sent.where(sent.dport == port)
    sizes = first.udp_bytes - UDP_HEADER_BYTES
    stops = np.cumsum(sizes)
    has_unique_ids = len(np.unique(first.ip_id)) == len(first)
    if not len(first) or not has_unique_ids or stops[-1] != size_bytes:
        return None
    index_by_id = {int(ip_id): index for index, ip_id in enumerate(first.ip_id)}
    fragments = received.where(np.isin(received.ip_id, first.ip_id))
    both = (fragments, sent.where(np.isin(sent.ip_id, first.ip_id)))
    # A later fragment of another flow with the same id cannot be distinguished from a fragment of the transfer.
    is_ambiguous = np.concatenate([(packets.fragment_offset == 0) & (packets.dport != port) for packets in both])
    if is_ambiguous.any():
        return None
    _, earliest = np.unique(np.stack((fragments.ip_id, fragments.fragment_offset)), axis=1, return_index=True)
    has_copies = len(earliest) < len(fragments)
    fragments = fragments.where(np.sort(earliest))
    order = np.argsort(fragments.ip_id, kind="stable")
    ids, starts = np.unique(fragments.ip_id[order], return_index=True)
    if not len(ids):
        return [], False
    fragment_bytes = np.add.reduceat(fragments.ip_payload_bytes[order], starts)
    complete_ns = np.maximum.reduceat(fragments.time_ns[order], starts)
    index = np.array([index_by_id[int(ip_id)] for ip_id in ids])
    is_complete = fragment_bytes == first.udp_bytes[index]
    order = np.argsort(complete_ns[is_complete], kind="stable")
    blocks = [_Block(int(stops[at] - sizes[at]), int(stops[at])) for at in index[is_complete][order]]
    return blocks, has_copies
