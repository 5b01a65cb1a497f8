"""Rates of a transfer, by the receiver's capture: throughput of its packets, goodput of the program.

Throughput is of IP-layer bits, header and payload of every packet received (RFC 5136, section 2.3.1). Goodput is of
the bits that the application got: no headers, nothing twice (RFC 2647, section 3.17; RFC 5166, section 2.1). What had
arrived when the clock began took no time of it and does not count, as in the dispersion of a packet train (Dovrolis,
Ramanathan and Moore 2001, INFOCOM, eq. 8): of packets that come at the rate of a link the rate is that of the link,
however few they are.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Value, columns
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.packets import FIN, SYN, Packets
from fieldkit.measure.transfers import tcp, udp
from fieldkit.measure.transfers.match import NONE
from fieldkit.measure.transfers.transfer import Transfer

COLUMNS: Final = columns(
    100,
    (
        "throughput_bit_s",
        "bit/s",
        (
            "IP-layer bits (RFC 5136) per second at the receiver's interface, retransmissions and copies included: "
            "of what came after the transfer's first packet with payload, from that packet to the last. Empty for a "
            "single packet, and without whole captures of both ends."
        ),
        Figure("throughput", Kind.MEDIAN, rank=51),
    ),
    (
        "completion_s",
        "s",
        (
            "First frame of the transfer in the receiver's capture until the program there had the file. TCP: it "
            "closed the connection, having got all; empty if it did not. UDP: its last whole datagram was there."
        ),
    ),
    (
        "goodput_bit_s",
        "bit/s",
        (
            "Bits of received_bytes per second of completion_s, what was there when it began left out. Empty where "
            "completion_s or received_bytes is, and where it is no time at all."
        ),
        Figure("goodput", Kind.MEDIAN, rank=50),
    ),
)

_SEQUENCE: Final = 1 << 32


@dataclass(frozen=True)
class Rates:
    """How fast a transfer was.

    Attributes:
        throughput_bit_s: IP-layer bits per second; None of fewer than two packets with payload, or without times.
        completion_s: Until the program had the file; None when it never had, or nobody knows.
        head_bytes: What the program got of it when the clock began.
    """

    throughput_bit_s: float | None
    completion_s: float | None
    head_bytes: int = 0

    def values(self, received_bytes: Value | None) -> dict[str, Value | None]:
        """Return the columns, given the size of the file that the program wrote."""
        goodput = None
        if isinstance(received_bytes, int) and self.completion_s:
            goodput = 8 * max(received_bytes - self.head_bytes, 0) / self.completion_s
        return {
            "throughput_bit_s": self.throughput_bit_s,
            "completion_s": self.completion_s,
            "goodput_bit_s": goodput,
        }


def of_udp(crossing: udp.UdpPackets) -> Rates:
    """Return the rates of a UDP transfer."""
    of_packet = crossing.match.sent_index
    came = np.append(crossing.chosen, False)[of_packet]  # the last entry is that of match.NONE
    received, datagram = crossing.received.where(came), np.append(crossing.datagram, NONE)[of_packet[came]]
    time_ns = received.time_ns
    if not len(received) or (time_ns == NO_TIME).any():
        return Rates(None, None)
    throughput = _throughput(received, np.ones(len(received), dtype=np.bool_), _ip_bytes(received))
    # Of each whole datagram, when its last fragment was there, copies of fragments left out.
    whole = udp.whole(crossing)[datagram] & ~crossing.match.duplicates[came]
    if not whole.any():
        return Rates(throughput, None)
    first = int(time_ns.argmin())
    head = int(udp.payload_bytes(received)[first]) if whole[first] else 0
    return Rates(throughput, float(time_ns[whole].max() - time_ns[first]) / 1e9, head)


def of_tcp(crossing: tcp.TcpFrames, receiver: Packets, transfer: Transfer, counts: tcp.TcpCounts) -> Rates:
    """Return the rates of a TCP transfer; of several connections only the throughput, for they have no common end.

    A frame of several segments that offload joined counts the headers that it took from them.

    Args:
        crossing: Its frames.
        receiver: Packets of the receiver's capture, which has the answers, too.
        transfer: What tells these.
        counts: What is counted of the frames.
    """
    received = crossing.received
    time_ns, payload = received.time_ns, received.tcp_payload_bytes
    if not (payload > 0).any() or (time_ns == NO_TIME).any():
        return Rates(None, None)
    mss = crossing.mss_bytes or int(payload.max())
    headers = received.ip_header_bytes + received.ip_payload_bytes - payload
    joined = np.maximum(-(-payload // mss) - 1, 0)
    throughput = _throughput(received, payload > 0, _ip_bytes(received) + joined * headers)
    closed_ns = _closed_ns(crossing.sent, receiver, transfer, counts)
    return Rates(throughput, None if closed_ns is None else float(closed_ns - time_ns.min()) / 1e9)


def _closed_ns(sent: Packets, receiver: Packets, transfer: Transfer, counts: tcp.TcpCounts) -> int | None:
    """Return when the receiver closed the connection, having acknowledged every byte; None if it did not.

    Netcat reads until the end of the connection and then leaves, so its kernel's FIN is as good as its word.
    """
    opening = sent.tcp_flags & SYN != 0
    if len(np.unique(sent.sport)) != 1 or len(isn := np.unique(sent.tcp_seq[opening])) != 1:
        return None
    back = transfer.backward(receiver)
    closing = back.where((back.sport == transfer.port) & (back.dport == sent.sport[0]) & (back.tcp_flags & FIN != 0))
    beyond = (closing.tcp_ack - (int(isn[0]) + 1 + counts.unique_bytes)) % _SEQUENCE
    times_ns = closing.time_ns[beyond < _SEQUENCE // 2]
    return None if not len(times_ns) or (times_ns == NO_TIME).any() else int(times_ns.min())


def _throughput(received: Packets, carries_payload: Mask, ip_bytes: Ints) -> float | None:
    order = np.argsort(received.time_ns, kind="stable")
    with_payload = np.flatnonzero(carries_payload[order])
    span = order[with_payload[0] : with_payload[-1] + 1]
    duration_ns = int(received.time_ns[span[-1]] - received.time_ns[span[0]])
    return 8e9 * int(ip_bytes[span[1:]].sum()) / duration_ns if duration_ns else None


def _ip_bytes(packets: Packets) -> Ints:
    return packets.ip_header_bytes + packets.ip_payload_bytes
