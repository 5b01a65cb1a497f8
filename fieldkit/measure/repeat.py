"""All numbers of one repeat, from the folder that holds its evidence."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fieldkit.columns import Measures
from fieldkit.errors import EvidenceError
from fieldkit.measure import bag, capture, evidence, host, paper, pcap, ping, tcp, udp
from fieldkit.measure.packets import Packets
from fieldkit.measure.transfer import Transfer
from fieldkit.model import Protocol

Piece = TypeVar("Piece")


def measure(folder: Path, transfer: Transfer) -> Measures:
    """Return what the evidence in `folder` says.

    What rests on missing, unreadable or damaged evidence is None, never a guess; whether the repeat is valid
    without it is for the evidence gates to say.

    Args:
        folder: Files named as `fieldkit.measure.evidence` declares.
        transfer: What was sent from where to where.
    """
    sender = _packets(folder / evidence.SENDER_CAPTURE)
    receiver = _packets(folder / evidence.RECEIVER_CAPTURE)
    pings = _known(ping.read, folder / evidence.PING)
    parts = (
        _files(folder, transfer),
        _captures(folder, sender, receiver),
        _layers(sender, receiver, transfer),
        _round_trips(pings),
        _paper(sender, receiver, pings, transfer),
        _host(folder),
    )
    return Measures(**{one.name: _first(parts, one.name) for one in fields(Measures)})


def _first(parts: tuple[Measures, ...], name: str) -> Any:  # noqa: ANN401 (the field's own type)
    return next((value for part in parts if (value := getattr(part, name)) is not None), None)


def _known(read: Callable[[Path], Piece], path: Path) -> Piece | None:
    """Return a piece of evidence, None when it is missing or not what it must be."""
    try:
        return read(path)
    except EvidenceError:
        return None


def _packets(path: Path) -> pcap.Capture | None:
    """Return a whole capture; counts from a damaged one would be guesses."""
    found = _known(pcap.read, path)
    return None if found is None or found.damage else found


def _loss(arrived: int | None, sent: int | None) -> float | None:
    """Return 1 - arrived/sent, the loss of the paper's eq. 1; None when nothing was sent."""
    return None if arrived is None or not sent else 1 - arrived / sent


def _files(folder: Path, transfer: Transfer) -> Measures:
    sent = _known(evidence.content, folder / transfer.sent_file)
    received = _known(evidence.content, folder / evidence.RECEIVED_FILE)
    contents = _known(bag.read, folder / transfer.sent_file)
    return Measures(
        sent_bytes=None if sent is None else len(sent),
        received_bytes=None if received is None else len(received),
        file_loss=None if sent is None or received is None else _loss(len(received), len(sent)),
        hash_match=None if sent is None or received is None else sent == received,
        bag_messages=contents.messages if contents else None,
        bag_duration_s=contents.duration_s if contents else None,
    )


def _captures(folder: Path, sender: pcap.Capture | None, receiver: pcap.Capture | None) -> Measures:
    sender_log = _known(capture.read, folder / evidence.SENDER_CAPTURE_LOG)
    receiver_log = _known(capture.read, folder / evidence.RECEIVER_CAPTURE_LOG)
    return Measures(
        sender_captured=sender.frames if sender else None,
        sender_capture_dropped=sender_log.dropped_by_kernel if sender_log else None,
        receiver_captured=receiver.frames if receiver else None,
        receiver_capture_dropped=receiver_log.dropped_by_kernel if receiver_log else None,
    )


def _layers(sender: pcap.Capture | None, receiver: pcap.Capture | None, transfer: Transfer) -> Measures:
    if sender is None or receiver is None:
        return Measures()
    layers = {Protocol.UDP: _udp, Protocol.TCP: _tcp}[transfer.protocol]
    return layers(sender.packets, receiver.packets, transfer)


def _udp(sender: Packets, receiver: Packets, transfer: Transfer) -> Measures:
    counts = udp.count(sender, receiver, transfer)
    return Measures(
        ip_packets_sent=counts.packets_sent,
        ip_packets_received=counts.packets_received,
        ip_loss=_loss(counts.packets_received, counts.packets_sent),
        datagrams_sent=counts.datagrams_sent,
        datagrams_received=counts.datagrams_received,
        datagram_loss=_loss(counts.datagrams_received, counts.datagrams_sent),
        byte_loss=_loss(counts.bytes_received, counts.bytes_sent),
        transfer_s=counts.transfer_s,
        transfer_from=None if counts.transfer_s is None else "receiver",
    )


def _tcp(sender: Packets, receiver: Packets, transfer: Transfer) -> Measures:
    counts = tcp.count(sender, receiver, transfer)
    return Measures(
        ip_packets_sent=counts.frames_sent,
        ip_packets_received=counts.frames_received,
        byte_loss=_loss(counts.unique_bytes - counts.lost_bytes, counts.unique_bytes),
        tcp_sent_bytes=counts.sent_bytes,
        tcp_unique_bytes=counts.unique_bytes,
        tcp_received_bytes=counts.received_bytes,
        tcp_byte_loss=_loss(counts.received_bytes, counts.sent_bytes),
        tcp_retransmitted_segments=counts.retransmitted_frames,
        transfer_s=counts.transfer_s,
        transfer_from=None if counts.transfer_s is None else "receiver",
    )


def _round_trips(pings: ping.Ping | None) -> Measures:
    # Without its first line ping never ran: no answer is then no measurement.
    if pings is None or pings.payload_bytes is None:
        return Measures()
    counts = Measures(
        rtt_sent=pings.transmitted,
        rtt_received=len(pings.answers),
        rtt_loss=_loss(len(pings.answers), pings.transmitted),
        rtt_payload_bytes=pings.payload_bytes,
    )
    rtt_s = pings.rtt_s
    if not rtt_s:
        return counts
    return replace(
        counts,
        rtt_min_s=min(rtt_s),
        rtt_median_s=float(np.median(rtt_s)),
        rtt_mean_s=float(np.mean(rtt_s)),
        rtt_p95_s=float(np.percentile(rtt_s, 95)),
        rtt_max_s=max(rtt_s),
    )


def _paper(
    sender: pcap.Capture | None, receiver: pcap.Capture | None, pings: ping.Ping | None, transfer: Transfer
) -> Measures:
    window_bytes = paper.WINDOW_BYTES[transfer.protocol]
    sent = paper.frames_from(sender.packets, transfer.sender_address, transfer.port) if sender else None
    received = paper.frames_to(receiver.packets, transfer.receiver_address, transfer.port) if receiver else None
    rtt_s = pings.rtt_s if pings and pings.payload_bytes == window_bytes else ()
    delay_s = float(np.mean(rtt_s)) if rtt_s else None
    return Measures(
        paper_packets=sent,
        paper_received=received,
        paper_window_bytes=window_bytes,
        paper_delay_s=delay_s,
        paper_transfer_s=None if sent is None or delay_s is None else paper.transfer_s(sent, delay_s),
        paper_loss=_loss(received, sent),
    )


def _host(folder: Path) -> Measures:
    before = _known(host.read, folder / evidence.RECEIVER_BEFORE)
    after = _known(host.read, folder / evidence.RECEIVER_AFTER)
    if before is None or after is None:
        return Measures()
    moved = host.difference(before, after)
    return Measures(
        receiver_udp_buffer_errors=moved.udp_buffer_errors,
        receiver_reassembly_failures=moved.reassembly_failures,
    )
