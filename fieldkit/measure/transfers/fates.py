"""Which packets of one transfer were lost or sent again, from the captures of both ends."""

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
    """Packets of a transfer at both ends.

    Attributes:
        sent_ns: Time of sending by the sender's clock, in the order of the capture. Shape (n,).
        sent_bytes: Offset of each sent packet in the payload, in bytes.
        marked: Mask of the sent packets that were lost (UDP), or that repeat bytes sent before (TCP).
        received_ns: Time of arrival by the receiver's clock. Shape (m,).
        received_bytes: Offset of each received packet in the payload.
    """

    sent_ns: Ints
    sent_bytes: NDArray[np.int64]
    marked: Mask
    received_ns: Ints
    received_bytes: NDArray[np.int64]


def both_packets(evidence: AttemptEvidence, transfer: Transfer) -> tuple[Packets, Packets]:
    """Return the packets of the sender's and the receiver's capture after checks that they can be compared.

    Args:
        evidence: The attempt's evidence.
        transfer: Identifies the packets of the transfer.

    Raises:
        EvidenceError: A capture is missing, damaged or without times, or the captures contradict each other.
    """
    captures = [evidence.whole_capture(name) for name in transfer.captures]
    if any(capture is None for capture in captures):
        raise EvidenceError("there are no complete captures of both ends", where=str(evidence.folder))
    sender, receiver = (capture.packets for capture in captures if capture is not None)
    if (sender.time_ns == NO_TIME).any() or (receiver.time_ns == NO_TIME).any():
        raise EvidenceError("a capture lacks times", where=str(evidence.folder))
    if why := strangers.reason(sender, receiver, transfer):
        raise EvidenceError(f"the captures of the transfer cannot be compared: {why}", where=str(evidence.folder))
    return sender, receiver


def read(evidence: AttemptEvidence, transfer: Transfer) -> Fates | None:
    """Return the fates of a transfer's packets.

    None if a capture is missing, damaged, without times or empty, if the captures contradict each other, or if it is
    ambiguous which packets were lost.

    Args:
        evidence: The attempt's evidence.
        transfer: Identifies the packets of the transfer.
    """
    try:
        sender, receiver = both_packets(evidence, transfer)
        fates = {Protocol.UDP: _udp, Protocol.TCP: _tcp}[transfer.protocol](sender, receiver, transfer)
    except EvidenceError:
        return None
    return fates if fates and len(fates.sent_ns) else None


def _udp(sender: Packets, receiver: Packets, transfer: Transfer) -> Fates | None:
    packets = udp.match_transfer(sender, receiver, transfer)
    chosen, sent_index = packets.chosen, packets.match.sent_index
    if (chosen & packets.match.ambiguous).any():
        return None
    offset_bytes = np.cumsum(packets.sent.ip_payload_bytes * chosen) - packets.sent.ip_payload_bytes
    received = np.append(chosen, False)[sent_index]  # the last entry is that of match.NONE
    return Fates(
        sent_ns=packets.sent.time_ns[chosen],
        sent_bytes=offset_bytes[chosen],
        marked=~packets.match.arrived[chosen],
        received_ns=packets.received.time_ns[received],
        received_bytes=offset_bytes[sent_index[received]],
    )


def _tcp(sender: Packets, receiver: Packets, transfer: Transfer) -> Fates:
    """Offload makes the frames at the two ends differ, so retransmissions are identified by sequence range."""
    sent, received = (
        packets.where((packets.dport == transfer.port) & (packets.tcp_payload_bytes > 0))
        for packets in (transfer.forward(sender), transfer.forward(receiver))
    )
    base = int(sent.tcp_seq[0]) if len(sent) else 0
    offset_bytes, received_offset_bytes = (_relative_seq(base, packets.tcp_seq) for packets in (sent, received))
    sent_up_to = np.maximum.accumulate(offset_bytes + sent.tcp_payload_bytes)
    return Fates(
        sent_ns=sent.time_ns,
        sent_bytes=offset_bytes,
        marked=np.append(np.zeros(min(1, len(sent)), dtype=np.bool_), offset_bytes[1:] < sent_up_to[:-1]),
        received_ns=received.time_ns,
        received_bytes=received_offset_bytes,
    )


def _relative_seq(base: int, tcp_seq: Ints) -> NDArray[np.int64]:
    """Return 32-bit sequence numbers relative to `base`, between -2**31 and 2**31 - 1."""
    return (tcp_seq - base + 2**31) % 2**32 - 2**31
