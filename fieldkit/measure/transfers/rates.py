"""Rates of a transfer from the receiver's capture: throughput of the packets, goodput of the program.

Throughput counts IP-layer bits: header and payload of every received packet (RFC 5136, section 2.3.1). Goodput counts
the bits that the application received, without headers and duplicates (RFC 2647, section 3.17; RFC 5166, section
2.1). The measured time starts with the arrival of the first packet, whose bits are not counted, as in the dispersion
of a packet train (Dovrolis, Ramanathan and Moore 2001, INFOCOM, eq. 8). If packets arrive at the rate of a link, the
result is then this rate for any number of packets.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Value, columns
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.packets import FIN, SYN, Packets
from fieldkit.measure.transfers import tcp, udp
from fieldkit.measure.transfers.match import NONE
from fieldkit.measure.transfers.transfer_spec import Transfer

COLUMNS: Final = columns(
    100,
    (
        "throughput_bit_s",
        "bit/s",
        (
            "IP-layer bits (RFC 5136) per second at the receiver's interface, including retransmissions and copies. "
            "The time starts with the transfer's first packet with payload, which is not counted, and ends with the "
            "last. Empty for a single packet, and without complete captures of both ends."
        ),
        Figure("throughput", Kind.MEDIAN, rank=51),
    ),
    (
        "completion_s",
        "s",
        (
            "Time from the first frame of the transfer in the receiver's capture until the program had received the "
            "file. TCP: until it closed the connection after it had received everything; empty if it did not. UDP: "
            "until the last complete datagram."
        ),
    ),
    (
        "goodput_bit_s",
        "bit/s",
        (
            "Bits of received_bytes per second of completion_s, without the bits in the first packet. Empty if "
            "completion_s or received_bytes is empty, and if completion_s is 0."
        ),
        Figure("goodput", Kind.MEDIAN, rank=50),
    ),
)

_SEQUENCE_NUMBERS: Final = 1 << 32
"""Number of TCP sequence numbers."""


@dataclass(frozen=True)
class Rates:
    """Rates of a transfer.

    Attributes:
        throughput_bit_s: IP-layer bits per second; None with fewer than two packets with payload, without times, or
            if the first and the last of these packets have the same time.
        completion_s: Time until the program had received the file: over TCP until it closed the connection after it
            had received every byte, over UDP until the last complete datagram. None if this did not happen, or if
            the time is unknown.
        head_bytes: Payload in the first packet of a UDP transfer, with which the measured time starts; 0 if its
            datagram is incomplete, and for TCP.
    """

    throughput_bit_s: float | None
    completion_s: float | None
    head_bytes: int = 0

    def values(self, received_bytes: Value | None) -> dict[str, Value | None]:
        """Return the columns; None for an unknown value.

        Args:
            received_bytes: Size of the file that the program wrote; None if unknown.
        """
        goodput = None
        if isinstance(received_bytes, int) and self.completion_s:
            goodput = 8 * max(received_bytes - self.head_bytes, 0) / self.completion_s
        return {
            "throughput_bit_s": self.throughput_bit_s,
            "completion_s": self.completion_s,
            "goodput_bit_s": goodput,
        }


def udp_rates(packets: udp.UdpPackets) -> Rates:
    """Return the rates of a UDP transfer."""
    sent_index = packets.match.sent_index
    # `match.NONE` (-1), for a packet that is not in the sender's capture, selects the appended False.
    is_of_transfer = np.append(packets.is_transfer_packet, False)[sent_index]
    received, datagram = (
        packets.received.where(is_of_transfer),
        np.append(packets.datagram, NONE)[sent_index[is_of_transfer]],
    )
    time_ns = received.time_ns
    if not len(received) or (time_ns == NO_TIME).any():
        return Rates(None, None)
    throughput = _throughput(received, np.ones(len(received), dtype=np.bool_), _ip_bytes(received))
    # A datagram is complete when its last fragment arrives; duplicates of fragments are ignored.
    is_useful = udp.complete(packets)[datagram] & ~packets.match.duplicates[is_of_transfer]
    if not is_useful.any():
        return Rates(throughput, None)
    first = int(time_ns.argmin())
    head_bytes = int(udp.payload_bytes(received)[first]) if is_useful[first] else 0
    return Rates(throughput, float(time_ns[is_useful].max() - time_ns[first]) / 1e9, head_bytes)


def tcp_rates(frames: tcp.TcpFrames, receiver: Packets, transfer: Transfer, counts: tcp.TcpCounts) -> Rates:
    """Return the rates of a TCP transfer; if it has several connections, only the throughput.

    If offload joined segments into a frame, the headers of these segments are added.

    Args:
        frames: Frames of the transfer in both captures.
        receiver: Packets of the receiver's capture, including the answers.
        transfer: Identifies the packets of the transfer.
        counts: Counts of the frames.
    """
    received = frames.received
    time_ns, payload = received.time_ns, received.tcp_payload_bytes
    if not (payload > 0).any() or (time_ns == NO_TIME).any():
        return Rates(None, None)
    mss = frames.mss_bytes or int(payload.max())
    headers = received.ip_header_bytes + received.ip_payload_bytes - payload
    extra_segments = np.maximum(-(-payload // mss) - 1, 0)  # the number of segments is rounded up
    throughput = _throughput(received, payload > 0, _ip_bytes(received) + extra_segments * headers)
    closed_ns = _closed_ns(frames.sent, receiver, transfer, counts)
    return Rates(throughput, None if closed_ns is None else float(closed_ns - time_ns.min()) / 1e9)


def _closed_ns(sent: Packets, receiver: Packets, transfer: Transfer, counts: tcp.TcpCounts) -> int | None:
    """Return the time at which the receiver closed the connection after it had acknowledged every byte.

    Return None if it did not, or if the time is unknown.

    netcat exits after it has read to the end of the connection. The FIN that its kernel then sends shows that it
    received every byte.
    """
    is_syn = sent.tcp_flags & SYN != 0
    if len(np.unique(sent.sport)) != 1 or len(initial_seqs := np.unique(sent.tcp_seq[is_syn])) != 1:
        return None  # there are several connections, or the start of the stream is unknown
    reverse = transfer.backward(receiver)
    closing = reverse.where(
        (reverse.sport == transfer.port) & (reverse.dport == sent.sport[0]) & (reverse.tcp_flags & FIN != 0)
    )
    # A difference below half of the sequence numbers is not negative: every byte is acknowledged.
    acked_beyond = (closing.tcp_ack - (int(initial_seqs[0]) + 1 + counts.unique_bytes)) % _SEQUENCE_NUMBERS
    times_ns = closing.time_ns[acked_beyond < _SEQUENCE_NUMBERS // 2]
    return None if not len(times_ns) or (times_ns == NO_TIME).any() else int(times_ns.min())


def _throughput(received: Packets, carries_payload: Mask, ip_bytes: Ints) -> float | None:
    """Return the bit/s from the first packet with payload to the last, without the bits of the first packet.

    Return None if there is only one such packet, or if the two packets have the same time.
    """
    order = np.argsort(received.time_ns, kind="stable")
    with_payload = np.flatnonzero(carries_payload[order])
    in_span = order[with_payload[0] : with_payload[-1] + 1]
    duration_ns = int(received.time_ns[in_span[-1]] - received.time_ns[in_span[0]])
    return 8e9 * int(ip_bytes[in_span[1:]].sum()) / duration_ns if duration_ns else None


def _ip_bytes(packets: Packets) -> Ints:
    return packets.ip_header_bytes + packets.ip_payload_bytes
