"""Fates of the packets of one transfer, from the captures of both ends: times, losses and retransmissions."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.ma import MaskedArray
from numpy.typing import NDArray

from fieldkit.core.columns import columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import altered_packets, delay, tcp, udp
from fieldkit.measure.transfers.clock_offset import StampPairs
from fieldkit.measure.transfers.transfer_spec import Transfer


@dataclass(frozen=True, eq=False)
class Fates:
    """Packets of a transfer at both ends.

    Attributes:
        sent_ns: Time of sending by the sender's clock, in the order of the capture. Shape (n,).
        sent_offset_bytes: Offset of each sent packet in the payload, in bytes. Shape (n,).
        lost_or_repeated: Mask of the sent packets that were lost (UDP), or that repeat bytes sent before (TCP).
        received_ns: Time of arrival by the receiver's clock. Shape (m,).
        received_offset_bytes: Offset of each received packet in the payload, in bytes. Shape (m,).
    """

    sent_ns: Ints
    sent_offset_bytes: NDArray[np.int64]
    lost_or_repeated: Mask
    received_ns: Ints
    received_offset_bytes: NDArray[np.int64]


def packets_of_both_ends(evidence: AttemptEvidence, transfer: Transfer) -> tuple[Packets, Packets]:
    """Return the packets of the sender's and the receiver's capture; raises if these cannot be compared.

    Args:
        evidence: The attempt's evidence.
        transfer: Identifies the packets of the transfer.

    Raises:
        EvidenceError: A capture is missing, damaged or without times, or the captures contradict each other.
    """
    captures = [evidence.undamaged_capture(name) for name in transfer.captures]
    if any(capture is None for capture in captures):
        raise EvidenceError("there are no complete captures of both ends", where=str(evidence.folder))
    sender, receiver = (capture.packets for capture in captures if capture is not None)
    if (sender.time_ns == NO_TIME).any() or (receiver.time_ns == NO_TIME).any():
        raise EvidenceError("a capture lacks times", where=str(evidence.folder))
    if reason := altered_packets.incomparability_reason(sender, receiver, transfer):
        raise EvidenceError(f"the captures of the transfer cannot be compared: {reason}", where=str(evidence.folder))
    return sender, receiver


def read(evidence: AttemptEvidence, transfer: Transfer) -> Fates | None:
    """Return the fates of a transfer's packets.

    Return None if a capture is missing, damaged, without times or empty, if the captures contradict each other, or if
    it is ambiguous which packets were lost.

    Args:
        evidence: The attempt's evidence.
        transfer: Identifies the packets of the transfer.
    """
    try:
        sender, receiver = packets_of_both_ends(evidence, transfer)
        fates = {Protocol.UDP: _udp_fates, Protocol.TCP: _tcp_fates}[transfer.protocol](sender, receiver, transfer)
    except EvidenceError:
        return None
    return fates if fates and len(fates.sent_ns) else None


def _udp_fates(sender: Packets, receiver: Packets, transfer: Transfer) -> Fates | None:
    """Return the fates of UDP packets, or None if it is ambiguous which packets were lost."""
    packets = udp.match_transfer(sender, receiver, transfer)
    is_transfer_packet, sent_index = packets.is_transfer_packet, packets.match.sent_index
    if (is_transfer_packet & packets.match.ambiguous).any():
        return None
    offset_bytes = np.cumsum(packets.sent.ip_payload_bytes * is_transfer_packet) - packets.sent.ip_payload_bytes
    received = np.append(is_transfer_packet, False)[sent_index]  # `match.NONE` (-1) selects the appended False
    return Fates(
        sent_ns=packets.sent.time_ns[is_transfer_packet],
        sent_offset_bytes=offset_bytes[is_transfer_packet],
        lost_or_repeated=~packets.match.arrived[is_transfer_packet],
        received_ns=packets.received.time_ns[received],
        received_offset_bytes=offset_bytes[sent_index[received]],
    )


def _tcp_fates(sender: Packets, receiver: Packets, transfer: Transfer) -> Fates:
    """Return the fates of TCP frames.

    Offload changes frames, so that they differ at both ends. Retransmissions are therefore identified by their range
    of sequence numbers.
    """
    sent, received = (
        packets.where((packets.dport == transfer.port) & (packets.tcp_payload_bytes > 0))
        for packets in (transfer.forward(sender), transfer.forward(receiver))
    )
    base = int(sent.tcp_seq[0]) if len(sent) else 0
    offset_bytes, received_offset_bytes = (_relative_seq(base, packets.tcp_seq) for packets in (sent, received))
    sent_up_to = np.maximum.accumulate(offset_bytes + sent.tcp_payload_bytes)
    return Fates(
        sent_ns=sent.time_ns,
        sent_offset_bytes=offset_bytes,
        lost_or_repeated=np.append(np.zeros(min(1, len(sent)), dtype=np.bool_), offset_bytes[1:] < sent_up_to[:-1]),
        received_ns=received.time_ns,
        received_offset_bytes=received_offset_bytes,
    )


def _relative_seq(base: int, tcp_seq: Ints) -> NDArray[np.int64]:
    """Return 32-bit sequence numbers relative to `base`, between -2**31 and 2**31 - 1."""
    return (tcp_seq - base + 2**31) % 2**32 - 2**31


PACKET_COLUMNS: Final = columns(
    0,
    ("sent_ns", "ns", "Time of sending by the sender's clock, nanoseconds since 1970 UTC."),
    (
        "received_ns",
        "ns",
        (
            "Arrival time of the packet's first copy by the receiver's clock; for a TCP frame, arrival time of its "
            "last byte. Empty if the packet was lost or is ambiguous, or if segmentation offload joined it to others."
        ),
    ),
    (
        "lost",
        "bool",
        (
            "True if the packet, or any byte of a TCP frame, did not arrive. Empty if ambiguous, and for all packets "
            "if a received packet may be a copy that hides a loss."
        ),
    ),
    ("sent_again", "bool", "True if any byte of the frame had been sent before. Empty for UDP."),
    ("wire_bytes", "B", "Length of the frame at the sender."),
    ("payload_bytes", "B", "Length of the packet after the IP header."),
    (
        "delay_s",
        "s",
        "One-way delay with the estimated clock offset; empty if received_ns or the clock offset is unknown.",
    ),
    (
        "delay_error_s",
        "s",
        "Maximum error of delay_s that is caused by the clocks; equal for all packets that have a delay.",
    ),
)


@dataclass(frozen=True, eq=False)
class SentPackets:
    """Packets that a transfer sent, in the order of the sender's capture; `PACKET_COLUMNS` describes the fields.

    For TCP, only frames with payload are included. All arrays have shape (n,); empty values are masked.
    """

    sent_ns: MaskedArray
    received_ns: MaskedArray
    lost: MaskedArray
    sent_again: MaskedArray
    wire_bytes: MaskedArray
    payload_bytes: MaskedArray
    delay_s: MaskedArray
    delay_error_s: MaskedArray


@dataclass(frozen=True, eq=False)
class _MatchedPackets:
    """Sent packets, shape (n,), and received packets, with their matches.

    Attributes:
        sent: Packets in the sender's capture.
        received: Packets in the receiver's capture.
        is_transfer_packet: Mask of the sent packets that belong to the transfer.
        lost: True for each packet that was lost; see `SentPackets.lost`.
        sent_again: True for each frame with bytes that had been sent before; see `SentPackets.sent_again`.
        pair_indices: Indices of the matched sent packets, and indices of their first copies among the received
            packets.
    """

    sent: Packets
    received: Packets
    is_transfer_packet: Mask
    lost: MaskedArray
    sent_again: MaskedArray
    pair_indices: tuple[Ints, Ints]


def read_sent_packets(evidence: AttemptEvidence, transfer: Transfer) -> SentPackets:
    """Return the packets of a transfer.

    Args:
        evidence: The attempt's evidence.
        transfer: Identifies the packets of the transfer.

    Raises:
        EvidenceError: For the same reasons as `packets_of_both_ends` and `tcp_streams.cut`.
    """
    sender, receiver = packets_of_both_ends(evidence, transfer)
    packets = {Protocol.UDP: _match_udp, Protocol.TCP: _match_tcp}[transfer.protocol](sender, receiver, transfer)
    sent_index, received_index = packets.pair_indices
    pairs = StampPairs(packets.sent.time_ns[sent_index], packets.received.time_ns[received_index])
    received_ns = _all_masked(len(packets.sent), np.int64)
    delay_s, error_s = (_all_masked(len(packets.sent), np.float64) for _ in range(2))
    received_ns[sent_index] = pairs.receiver_ns
    if (delays := delay.packet_delays(pairs, sender, receiver, transfer)) is not None:
        delay_s[sent_index], error_s[sent_index] = delays
    return SentPackets(
        sent_ns=np.ma.array(packets.sent.time_ns[packets.is_transfer_packet]),
        received_ns=received_ns[packets.is_transfer_packet],
        lost=packets.lost[packets.is_transfer_packet],
        sent_again=packets.sent_again[packets.is_transfer_packet],
        wire_bytes=np.ma.array(packets.sent.wire_bytes[packets.is_transfer_packet]),
        payload_bytes=np.ma.array(packets.sent.ip_payload_bytes[packets.is_transfer_packet]),
        delay_s=delay_s[packets.is_transfer_packet],
        delay_error_s=error_s[packets.is_transfer_packet],
    )


def _all_masked(rows: int, kind: type[np.generic]) -> MaskedArray:
    return np.ma.array(np.zeros(rows, kind), mask=True)


def _match_udp(sender: Packets, receiver: Packets, transfer: Transfer) -> _MatchedPackets:
    matched = udp.match_transfer(sender, receiver, transfer)
    # Each received packet that may be a copy may hide the loss of another packet.
    may_hide_loss = (
        np.append(matched.is_transfer_packet, False)[matched.match.sent_index] & matched.match.possible_copy
    )
    return _MatchedPackets(
        sent=matched.sent,
        received=matched.received,
        is_transfer_packet=matched.is_transfer_packet,
        lost=np.ma.array(~matched.match.arrived, mask=matched.match.ambiguous | may_hide_loss.any()),
        sent_again=_all_masked(len(matched.sent), np.bool_),
        pair_indices=delay.udp_pair_indices(matched),
    )


def _match_tcp(sender: Packets, receiver: Packets, transfer: Transfer) -> _MatchedPackets:
    matched = tcp.match_transfer(sender, receiver, transfer)
    pieces, match = matched.payload.sent, matched.payload.match
    lost, ambiguous = np.zeros((2, len(matched.sent)), dtype=np.bool_)
    lost[pieces.frame[~match.arrived]] = True
    ambiguous[pieces.frame[match.ambiguous]] = True
    return _MatchedPackets(
        sent=matched.sent,
        received=matched.received,
        is_transfer_packet=matched.sent.tcp_payload_bytes > 0,
        lost=np.ma.array(lost, mask=ambiguous | match.possible_copy.any()),
        sent_again=np.ma.array(tcp.sent_again(matched)),
        pair_indices=delay.tcp_pair_indices(matched),
    )
