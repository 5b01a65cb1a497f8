"""What two captures say of one transfer, layer by layer, under the names of the columns."""

from collections.abc import Iterator

from fieldkit.core.columns import Measures
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import delay, tcp, udp
from fieldkit.measure.transfers.transfer import Transfer


def measure(sender: Packets, receiver: Packets, transfer: Transfer) -> Iterator[Measures]:
    """Yield what the packets of both captures say of a transfer: its losses, and its delay.

    Raises:
        EvidenceError: See `ranges.cut`.
    """
    if transfer.protocol is Protocol.UDP:
        crossing = udp.cross(sender, receiver, transfer)
        own = delay.udp_packets(crossing)
        yield _udp(udp.count(crossing))
    else:
        own = delay.tcp_frames(sender, receiver, transfer)
        yield _tcp(tcp.count(sender, receiver, transfer))
    yield from delay.measure(own, sender, receiver, transfer)


def _udp(counts: udp.UdpCounts) -> Measures:
    return Measures(
        ip_packets_sent=counts.packets_sent,
        ip_packets_received=counts.packets_received,
        ip_loss=loss(counts.packets_received, counts.packets_sent),
        ip_packets_duplicated=counts.packets_duplicated,
        ip_packets_reordered=counts.packets_reordered,
        ip_packets_doubtful=counts.packets_doubtful,
        ip_loss_bursts=counts.loss_bursts,
        ip_loss_longest_burst=counts.longest_burst,
        datagrams_sent=counts.datagrams_sent,
        datagrams_received=counts.datagrams_received,
        datagram_loss=loss(counts.datagrams_received, counts.datagrams_sent),
        byte_loss=loss(counts.bytes_received, counts.bytes_sent),
        transfer_s=counts.transfer_s,
        transfer_from=None if counts.transfer_s is None else "receiver",
    )


def _tcp(counts: tcp.TcpCounts) -> Measures:
    return Measures(
        ip_packets_sent=counts.frames_sent,
        ip_packets_received=counts.frames_received,
        byte_loss=loss(counts.unique_bytes - counts.lost_bytes, counts.unique_bytes),
        tcp_sent_bytes=counts.sent_bytes,
        tcp_unique_bytes=counts.unique_bytes,
        tcp_received_bytes=counts.received_bytes,
        tcp_byte_loss=loss(counts.received_bytes, counts.sent_bytes),
        tcp_retransmitted_segments=counts.retransmitted_frames,
        tcp_spurious_segments=counts.spurious_frames,
        tcp_duplicated_bytes=counts.duplicated_bytes,
        tcp_reordered_segments=counts.reordered_frames,
        tcp_doubtful_segments=counts.doubtful_frames,
        tcp_superframes=counts.superframes,
        transfer_s=counts.transfer_s,
        transfer_from=None if counts.transfer_s is None else "receiver",
    )


def loss(arrived: int | None, sent: int | None) -> float | None:
    """Return 1 - arrived/sent, the loss of the paper's eq. 1; None when nothing was sent."""
    return None if arrived is None or not sent else 1 - arrived / sent
