"""Contradictions between what two captures and two files say of one transfer: one of them is not whole.

Each is one whatever the link loses, copies or reorders, and whatever the two clocks say.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fieldkit.core.model import Protocol
from fieldkit.core.units import format_count
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Keys, mixed
from fieldkit.measure.captures.packets import NO_PORT, RST, SYN, UDP_HEADER_BYTES, Packets
from fieldkit.measure.checks import udp_file
from fieldkit.measure.evidence import reading
from fieldkit.measure.transfers.streams import LONGEST_BYTES, Connections
from fieldkit.measure.transfers.transfer import Transfer


@dataclass(frozen=True)
class _Files:
    """Sizes of both files of a transfer, and how many bytes they have in common from the beginning on."""

    sent_bytes: int
    received_bytes: int
    alike_bytes: int

    @property
    def whole(self) -> bool:
        return self.sent_bytes == self.received_bytes == self.alike_bytes


def find(evidence: AttemptEvidence, transfer: Transfer, *, finished: bool, cut: bool = False) -> Iterator[str]:
    """Yield what cannot be true together, a sentence each; evidence that is not whole contradicts nothing.

    Args:
        evidence: What the attempt left.
        transfer: What was sent from where to where.
        finished: Whether the listener is known to have ended by itself.
        cut: Whether it is known to have been ended before it was done.
    """
    files = _files(evidence, transfer)
    if files and transfer.protocol is Protocol.TCP and files.alike_bytes < files.received_bytes:
        yield f"{transfer.received_file} is no beginning of {transfer.sent_file}, and TCP changes no byte"
    sender, receiver = map(evidence.whole_capture, transfer.captures)
    if sender is None or receiver is None:
        return
    if earlier := _earlier(sender.packets, receiver.packets, transfer):
        yield f"packets of an earlier attempt were still on the way: {earlier}"
    elif transfer.protocol is Protocol.UDP:
        amounts = list(_udp(sender.packets, receiver.packets, files, transfer))
        yield from amounts or udp_file.find(evidence, transfer, sender.packets, receiver.packets, cut=cut)
    elif files is None or max(files.sent_bytes, files.received_bytes) < LONGEST_BYTES:
        yield from _tcp(sender.packets, receiver.packets, files, transfer, finished=finished)


def _files(evidence: AttemptEvidence, transfer: Transfer) -> _Files | None:
    sent = evidence.read_or_none(reading.size, transfer.sent_file)
    received = evidence.read_or_none(reading.size, transfer.received_file)
    alike = evidence.read_or_none(reading.alike_bytes, "", transfer.sent_file, transfer.received_file)
    return None if sent is None or received is None or alike is None else _Files(sent, received, alike)


def _earlier(sender: Packets, receiver: Packets, transfer: Transfer) -> str | None:
    """Return which packets are of an earlier transfer, None where none are: of one transfer each netcat has one port.

    They came with payload from a port from which nothing left; or they had waited on the sender, and left from
    another port than the last that began. What a kernel still repeats of a connection that broke off begins none.
    """
    left, came = (
        packets.where(packets.dport == transfer.port) for packets in map(transfer.forward, (sender, receiver))
    )
    carries = (came.tcp_payload_bytes > 0) | (came.udp_bytes > 0)
    if on_the_way := int((carries & ~np.isin(came.sport, left.sport)).sum()):
        return f"{format_count(on_the_way, 'packet')} of the transfer's port came from another than any that left"
    begun = left if transfer.protocol is Protocol.UDP else left.where(left.tcp_flags & SYN != 0)
    ports, first = np.unique(begun.sport, return_index=True)
    if len(ports) > 1:
        waited = int((begun.sport != ports[first.argmax()]).sum())
        return f"{format_count(waited, 'packet')} left for the transfer's port before its sender began"
    return None


def _amounts(files: _Files, left_bytes: int, arrived_bytes: int, transfer: Transfer) -> Iterator[str]:
    """Yield where captures hold more than was sent, or less than was received."""
    if left_bytes > files.sent_bytes:
        yield f"{left_bytes} bytes left the {transfer.source}, and {transfer.sent_file} has {files.sent_bytes}"
    if files.received_bytes > arrived_bytes:
        held = f"holds {arrived_bytes} bytes of the transfer"
        file = f"{transfer.received_file} has {files.received_bytes}"
        yield f"the {transfer.destination}'s capture {held}, and {file}"


def _udp(sender: Packets, receiver: Packets, files: _Files | None, transfer: Transfer) -> Iterator[str]:
    both = transfer.forward(sender), transfer.forward(receiver)
    # A capture also holds later fragments of what other programs send.
    ids = np.concatenate([packets.ip_id[packets.dport == transfer.port] for packets in both])
    sent, received = (
        packets.where((packets.dport == transfer.port) | (packets.dport == NO_PORT) & np.isin(packets.ip_id, ids))
        for packets in both
    )
    first, first_received = sent.dport == transfer.port, received.dport == transfer.port
    keys, keys_received = _keys(sent), _keys(received)
    if strange := int((~np.isin(keys_received[first_received], keys[first])).sum()):
        yield f"{format_count(strange, 'datagram')} arrived that the {transfer.source}'s capture did not see leave"
    if files is None:
        return
    # What arrived is neither more than the first fragments announce, nor more than all of them carry.
    announced = received.udp_bytes[first_received]
    arrived_bytes = min(int(announced.sum()), int(received.ip_payload_bytes.sum())) - UDP_HEADER_BYTES * len(
        announced
    )
    left_bytes = int((sent.udp_bytes[first] - UDP_HEADER_BYTES).sum())
    yield from _amounts(files, left_bytes, arrived_bytes, transfer)
    # Copies can make up for what is missing in sum, but not packet by packet. Of a fragment whose id is another
    # transfer's, too, nobody says whose it is.
    others = np.concatenate(
        [packets.ip_id[(packets.dport != transfer.port) & (packets.dport != NO_PORT)] for packets in both]
    )
    certain = first | ~np.isin(sent.ip_id, others)
    missing = int((~np.isin(keys[certain], keys_received)).sum())
    if missing and files.whole and files.received_bytes <= arrived_bytes:
        lack = f"lacks {format_count(missing, 'packet')} of it"
        yield f"{transfer.received_file} is whole, and the {transfer.destination}'s capture {lack}"


def _keys(packets: Packets) -> Keys:
    """Return a number of each packet that both ends see alike, and hardly in another one."""
    return mixed(packets.ip_id << 16 | packets.fragment_offset, packets.ip_payload_bytes, packets.sport + 1)


def _tcp(
    sender: Packets, receiver: Packets, files: _Files | None, transfer: Transfer, *, finished: bool
) -> Iterator[str]:
    left, came = (
        packets.where(packets.dport == transfer.port)
        for packets in (transfer.forward(sender), transfer.forward(receiver))
    )
    answered, answered_there = (
        packets.where(packets.sport == transfer.port)
        for packets in (transfer.backward(sender), transfer.backward(receiver))
    )
    if _refused(left, answered):
        yield f"the {transfer.destination} refused the connection: nobody listened when the {transfer.source} began"
        return
    begun = {transfer.source: Connections.begun(left), transfer.destination: Connections.begun(came)}
    loaded = np.unique(came.sport[came.tcp_payload_bytes > 0])
    seen = {role: connections.have(loaded) for role, connections in begun.items()}
    for role, mask in seen.items():
        # What neither saw begin is what the kernel still repeats of an earlier transfer.
        if (~mask & np.logical_or(*seen.values())).any():
            yield f"bytes arrived by a connection whose beginning is not in the {role}'s capture"
            return
    connections = begun[transfer.source]
    if strange := connections.payload(came).beyond(connections.payload(left)):
        yield f"{format_count(strange, 'byte')} arrived that the {transfer.source}'s capture did not see leave"
    answers = Packets.joined((answered, answered_there))
    acknowledged = connections.acknowledged(answers)
    for frames, role in ((left, transfer.source), (came, transfer.destination)):
        if missing := acknowledged.beyond(connections.numbers(frames)):
            yield f"{format_count(missing, 'byte')} were acknowledged that are not in the {role}'s capture"
    if files is None:
        return
    arrived_bytes = connections.payload(came).size_bytes
    yield from _amounts(files, connections.payload(left).size_bytes, arrived_bytes, transfer)
    ended = not connections.numbers(left).beyond(acknowledged)
    # A kernel refuses the rest with a reset where a program stops reading before the end.
    refused = (answers.tcp_flags & RST != 0).any()
    if finished and (ended or refused) and files.received_bytes < arrived_bytes:
        what = f"{arrived_bytes} bytes arrived, and {transfer.received_file} has {files.received_bytes}"
        yield f"{what}, though its listener ended as if it had them all"


def _refused(left: Packets, answers: Packets) -> bool:
    """Return whether the first call of a sender was refused, and none accepted; a lost one is the link's work."""
    resets = answers.where(answers.tcp_flags & RST != 0)
    if not len(resets) or (answers.tcp_flags & SYN != 0).any():
        return False
    calls = left.where((left.tcp_flags & SYN != 0) & (left.time_ns <= resets.time_ns.min()))
    return len(calls) == 1
