"""The packets of one transfer as rows: time of sending and arrival, loss and delay of each."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.ma import MaskedArray

from fieldkit.core.columns import columns
from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Ints, Mask
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import delay, fates, tcp, udp
from fieldkit.measure.transfers.clocks import StampPairs
from fieldkit.measure.transfers.transfer import Transfer

COLUMNS: Final = columns(
    0,
    ("sent_ns", "ns", "Time of sending by the sender's clock, since 1970 UTC."),
    (
        "received_ns",
        "ns",
        (
            "Time at which its first copy arrived, by the receiver's clock; for a TCP frame the last byte's. Empty if"
            " it was lost, if it is ambiguous, and if offload joined it to others."
        ),
    ),
    (
        "lost",
        "bool",
        "True if it did not arrive, or for a TCP frame if any byte did not; empty if ambiguous.",
    ),
    ("sent_again", "bool", "True if any of its bytes had been sent before. Empty for UDP."),
    ("wire_bytes", "B", "Length of the frame at the sender."),
    ("payload_bytes", "B", "Length after the IP header."),
    (
        "delay_s",
        "s",
        "One-way delay by the estimated clock offset; empty if received_ns or that offset is unknown.",
    ),
    (
        "delay_error_s",
        "s",
        "Maximum error of delay_s from the clocks, equal for all packets that have one.",
    ),
)


@dataclass(frozen=True, eq=False)
class Crossings:
    """Packets that a transfer sent, in the order of the sender's capture; the fields are those of `COLUMNS`.

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
    """Packets sent, shape (n,), and received, with their matches.

    Attributes:
        sent: Packets in the sender's capture.
        received: Packets in the receiver's capture.
        chosen: Mask of the sent packets that belong to the transfer.
        lost: As `Crossings.lost`.
        sent_again: As `Crossings.sent_again`.
        copies: Indices of matched sent packets, and of their copies among the received packets.
    """

    sent: Packets
    received: Packets
    chosen: Mask
    lost: MaskedArray
    sent_again: MaskedArray
    copies: tuple[Ints, Ints]


def read(evidence: AttemptEvidence, transfer: Transfer) -> Crossings:
    """Return the packets of a transfer.

    Args:
        evidence: The attempt's evidence.
        transfer: Identifies the packets of the transfer.

    Raises:
        EvidenceError: As for `fates.both_packets` and `ranges.cut`.
    """
    sender, receiver = fates.both_packets(evidence, transfer)
    packets = {Protocol.UDP: _udp, Protocol.TCP: _tcp}[transfer.protocol](sender, receiver, transfer)
    sent_index, received_index = packets.copies
    pairs = StampPairs(packets.sent.time_ns[sent_index], packets.received.time_ns[received_index])
    received_ns = _empty(len(packets.sent), np.int64)
    delay_s, error_s = (_empty(len(packets.sent), np.float64) for _ in range(2))
    received_ns[sent_index] = pairs.receiver_ns
    if (delays := delay.packet_delays(pairs, sender, receiver, transfer)) is not None:
        delay_s[sent_index], error_s[sent_index] = delays
    return Crossings(
        sent_ns=np.ma.array(packets.sent.time_ns[packets.chosen]),
        received_ns=received_ns[packets.chosen],
        lost=packets.lost[packets.chosen],
        sent_again=packets.sent_again[packets.chosen],
        wire_bytes=np.ma.array(packets.sent.wire_bytes[packets.chosen]),
        payload_bytes=np.ma.array(packets.sent.ip_payload_bytes[packets.chosen]),
        delay_s=delay_s[packets.chosen],
        delay_error_s=error_s[packets.chosen],
    )


def _empty(rows: int, kind: type[np.generic]) -> MaskedArray:
    return np.ma.array(np.zeros(rows, kind), mask=True)


def _udp(sender: Packets, receiver: Packets, transfer: Transfer) -> _MatchedPackets:
    crossing = udp.match_transfer(sender, receiver, transfer)
    # Each received packet that may be a copy may hide the loss of another packet.
    hidden = np.append(crossing.chosen, False)[crossing.match.sent_index] & crossing.match.possible_copy
    return _MatchedPackets(
        sent=crossing.sent,
        received=crossing.received,
        chosen=crossing.chosen,
        lost=np.ma.array(~crossing.match.arrived, mask=crossing.match.ambiguous | hidden.any()),
        sent_again=_empty(len(crossing.sent), np.bool_),
        copies=delay.udp_copies(crossing),
    )


def _tcp(sender: Packets, receiver: Packets, transfer: Transfer) -> _MatchedPackets:
    crossing = tcp.match_transfer(sender, receiver, transfer)
    pieces, match = crossing.payload.sent, crossing.payload.match
    lost, ambiguous = np.zeros((2, len(crossing.sent)), dtype=np.bool_)
    lost[pieces.frame[~match.arrived]] = True
    ambiguous[pieces.frame[match.ambiguous]] = True
    return _MatchedPackets(
        sent=crossing.sent,
        received=crossing.received,
        chosen=crossing.sent.tcp_payload_bytes > 0,
        lost=np.ma.array(lost, mask=ambiguous | match.possible_copy.any()),
        sent_again=np.ma.array(tcp.sent_again(crossing)),
        copies=delay.tcp_copies(crossing),
    )
