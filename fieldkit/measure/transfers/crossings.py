"""Each packet of one transfer as a row: when it left, when it arrived, how long it took."""

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
    ("sent_ns", "ns", "When it left, by the sender's clock, since 1970 UTC."),
    (
        "received_ns",
        "ns",
        (
            "When its first copy arrived, by the receiver's clock; of a frame of TCP its last byte. Empty where it"
            " was lost, where nothing tells it from others, and where offload joined it to others."
        ),
    ),
    (
        "lost",
        "bool",
        "Whether it, or of a frame of TCP any of its bytes, did not arrive; empty where nothing tells.",
    ),
    ("sent_again", "bool", "Whether any of its bytes had been sent before. Empty for UDP."),
    ("wire_bytes", "B", "Length of the frame at the sender."),
    ("payload_bytes", "B", "Bytes after the IP header."),
    (
        "delay_s",
        "s",
        "One-way delay by the estimated offset of the clocks; empty where received_ns or that offset is not known.",
    ),
    (
        "delay_error_s",
        "s",
        "The most that delay_s can be wrong by the two clocks, the same of all packets that have one.",
    ),
)


@dataclass(frozen=True, eq=False)
class Crossings:
    """The packets of a transfer that were sent, in the order of the sender's capture; the fields are `COLUMNS`.

    Of TCP they are the frames with payload. All are of shape (n,); what is empty is masked.
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
class _Seen:
    """What both captures say of packets sent, shape (n,), and received.

    Attributes:
        sent: In the sender's capture.
        received: In the receiver's.
        chosen: Which of those sent are the transfer's.
        lost: As `Crossings`.
        again: As `Crossings.sent_again`.
        copies: Index of packets among those sent, and of their copies among those received.
    """

    sent: Packets
    received: Packets
    chosen: Mask
    lost: MaskedArray
    again: MaskedArray
    copies: tuple[Ints, Ints]


def read(evidence: AttemptEvidence, transfer: Transfer) -> Crossings:
    """Return the packets of a transfer.

    Args:
        evidence: What the attempt left.
        transfer: What tells its packets from others.

    Raises:
        EvidenceError: As `fates.ends` and `ranges.cut`.
    """
    sender, receiver = fates.ends(evidence, transfer)
    seen = {Protocol.UDP: _udp, Protocol.TCP: _tcp}[transfer.protocol](sender, receiver, transfer)
    left, came = seen.copies
    own = StampPairs(seen.sent.time_ns[left], seen.received.time_ns[came])
    received_ns = _empty(len(seen.sent), np.int64)
    delay_s, error_s = (_empty(len(seen.sent), np.float64) for _ in range(2))
    received_ns[left] = own.receiver_ns
    if (told := delay.of_each(own, sender, receiver, transfer)) is not None:
        delay_s[left], error_s[left] = told
    return Crossings(
        sent_ns=np.ma.array(seen.sent.time_ns[seen.chosen]),
        received_ns=received_ns[seen.chosen],
        lost=seen.lost[seen.chosen],
        sent_again=seen.again[seen.chosen],
        wire_bytes=np.ma.array(seen.sent.wire_bytes[seen.chosen]),
        payload_bytes=np.ma.array(seen.sent.ip_payload_bytes[seen.chosen]),
        delay_s=delay_s[seen.chosen],
        delay_error_s=error_s[seen.chosen],
    )


def _empty(rows: int, kind: type[np.generic]) -> MaskedArray:
    return np.ma.array(np.zeros(rows, kind), mask=True)


def _udp(sender: Packets, receiver: Packets, transfer: Transfer) -> _Seen:
    found = udp.cross(sender, receiver, transfer)
    # As many losses may hide behind copies that cannot be told from packets that were sent.
    hidden = np.append(found.chosen, False)[found.match.sent_index] & found.match.dubious
    return _Seen(
        sent=found.sent,
        received=found.received,
        chosen=found.chosen,
        lost=np.ma.array(~found.match.arrived, mask=found.match.doubtful | hidden.any()),
        again=_empty(len(found.sent), np.bool_),
        copies=delay.udp_copies(found),
    )


def _tcp(sender: Packets, receiver: Packets, transfer: Transfer) -> _Seen:
    found = tcp.cross(sender, receiver, transfer)
    pieces, match = found.payload.sent, found.payload.match
    lost, doubtful = np.zeros((2, len(found.sent)), dtype=np.bool_)
    lost[pieces.frame[~match.arrived]] = True
    doubtful[pieces.frame[match.doubtful]] = True
    return _Seen(
        sent=found.sent,
        received=found.received,
        chosen=found.sent.tcp_payload_bytes > 0,
        lost=np.ma.array(lost, mask=doubtful | match.dubious.any()),
        again=np.ma.array(tcp.sent_again(found)),
        copies=delay.tcp_copies(found),
    )
