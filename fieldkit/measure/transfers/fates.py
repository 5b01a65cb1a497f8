"""Fate of each packet of one transfer, from the captures of both ends."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import strangers, udp
from fieldkit.measure.transfers.transfer import Transfer


@dataclass(frozen=True, eq=False)
class Fates:
    """The packets of a transfer at both ends.

    Attributes:
        sent_ns: When each left, by the sender's clock, in the order of the capture. Shape (n,).
        sent_bytes: Where in the payload it begins, in bytes.
        marked: Which were lost (UDP), or carry what had been sent before (TCP).
        received_ns: When each arrived, by the receiver's clock. Shape (m,).
        received_bytes: Where in the payload it begins.
    """

    sent_ns: Ints
    sent_bytes: NDArray[np.int64]
    marked: Mask
    received_ns: Ints
    received_bytes: NDArray[np.int64]


def ends(evidence: AttemptEvidence, transfer: Transfer) -> tuple[Packets, Packets]:
    """Return the packets of the captures of sender and receiver, of which the fates of a transfer's can be told.

    Args:
        evidence: What the attempt left.
        transfer: What tells its packets from others.

    Raises:
        EvidenceError: A capture is missing, damaged or without times, or the two contradict each other.
    """
    captures = [evidence.whole_capture(name) for name in transfer.captures]
    if any(capture is None for capture in captures):
        raise EvidenceError("there are no whole captures of both ends", where=str(evidence.folder))
    sender, receiver = (capture.packets for capture in captures if capture is not None)
    if (sender.time_ns == NO_TIME).any() or (receiver.time_ns == NO_TIME).any():
        raise EvidenceError("a capture lacks times", where=str(evidence.folder))
    if why := strangers.reason(sender, receiver, transfer):
        raise EvidenceError(f"the captures of the transfer do not compare: {why}", where=str(evidence.folder))
    return sender, receiver


def read(evidence: AttemptEvidence, transfer: Transfer) -> Fates | None:
    """Return the fates of a transfer's packets; None where a capture is missing, damaged, without times, or empty.

    None, too, where its packets contradict each other, or look so much alike that nobody knows which were lost.

    Args:
        evidence: What the attempt left.
        transfer: What tells its packets from others.
    """
    try:
        sender, receiver = ends(evidence, transfer)
        fates = {Protocol.UDP: _udp, Protocol.TCP: _tcp}[transfer.protocol](sender, receiver, transfer)
    except EvidenceError:
        return None
    return fates if fates and len(fates.sent_ns) else None


def _udp(sender: Packets, receiver: Packets, transfer: Transfer) -> Fates | None:
    crossing = udp.cross(sender, receiver, transfer)
    chosen, sent_index = crossing.chosen, crossing.match.sent_index
    if (chosen & crossing.match.doubtful).any():
        return None
    begins = np.cumsum(crossing.sent.ip_payload_bytes * chosen) - crossing.sent.ip_payload_bytes
    came = np.append(chosen, False)[sent_index]  # the last entry is that of match.NONE
    return Fates(
        sent_ns=crossing.sent.time_ns[chosen],
        sent_bytes=begins[chosen],
        marked=~crossing.match.arrived[chosen],
        received_ns=crossing.received.time_ns[came],
        received_bytes=begins[sent_index[came]],
    )


def _tcp(sender: Packets, receiver: Packets, transfer: Transfer) -> Fates:
    """Offload makes frames of both ends differ, so none is matched: what went again is told by its sequence range."""
    sent, received = (
        packets.where((packets.dport == transfer.port) & (packets.tcp_payload_bytes > 0))
        for packets in (transfer.forward(sender), transfer.forward(receiver))
    )
    base = int(sent.tcp_seq[0]) if len(sent) else 0
    begins, begins_received = (_since(base, packets.tcp_seq) for packets in (sent, received))
    reached = np.maximum.accumulate(begins + sent.tcp_payload_bytes)
    return Fates(
        sent_ns=sent.time_ns,
        sent_bytes=begins,
        marked=np.append(np.zeros(min(1, len(sent)), dtype=np.bool_), begins[1:] < reached[:-1]),
        received_ns=received.time_ns,
        received_bytes=begins_received,
    )


def _since(base: int, tcp_seq: Ints) -> NDArray[np.int64]:
    """Return how far sequence numbers, of 32 bits, are from `base`, each the shorter way round."""
    return (tcp_seq - base + 2**31) % 2**32 - 2**31
