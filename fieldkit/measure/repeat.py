"""All numbers of one repeat, from the folder that holds its evidence."""

from collections.abc import Collection, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldkit.core.columns import Measures, of_fault
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind
from fieldkit.measure import layers
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.evidence import bag, host, lateness, medium, ping, reading, recovery, tcpdump_log, track
from fieldkit.measure.evidence.reading import known as _known
from fieldkit.measure.layers import loss
from fieldkit.measure.transfers import paper
from fieldkit.measure.transfers.transfer import Transfer


def measure(folder: Path, transfer: Transfer | None) -> Measures:
    """Return what the evidence in `folder` says.

    What rests on missing, unreadable or damaged evidence is None, never a guess; whether the repeat is valid
    without it is for the evidence gates to say.

    Args:
        folder: Files named as `fieldkit.measure.evidence.reading` declares.
        transfer: What was sent from where to where; None when nothing was.
    """
    pings = _known(ping.read, folder / reading.PING)
    parts = (
        *(() if transfer is None else _transfer(folder, transfer, pings)),
        _round_trips(pings),
        _air(folder),
        _lateness(folder),
        _apart(folder, "rtt", [] if pings is None else [at for one in pings.answers if (at := one.at_utc_ns)]),
        *(_fault(folder, kind) for kind in FaultKind),
    )
    return Measures(**{one.name: _first(parts, one.name) for one in fields(Measures)})


def _transfer(folder: Path, transfer: Transfer, pings: ping.Ping | None) -> tuple[Measures, ...]:
    sender = _packets(folder / reading.SENDER_CAPTURE)
    receiver = _packets(folder / reading.RECEIVER_CAPTURE)
    return (
        _files(folder, transfer),
        _captures(folder, sender, receiver),
        *_layers(sender, receiver, transfer),
        _paper(sender, receiver, pings, transfer),
        _host(folder),
        _apart(folder, "transfer", _sent_ns(sender, transfer)),
    )


def _first(parts: tuple[Measures, ...], name: str) -> Any:  # noqa: ANN401 (the field's own type)
    return next((value for part in parts if (value := getattr(part, name)) is not None), None)


def _packets(path: Path) -> pcap.Capture | None:
    """Return a whole capture; counts from a damaged one would be guesses."""
    found = _known(pcap.read, path)
    return None if found is None or found.damage else found


def _files(folder: Path, transfer: Transfer) -> Measures:
    sent = _known(reading.content, folder / transfer.sent_file)
    received = _known(reading.content, folder / reading.RECEIVED_FILE)
    contents = _known(bag.read, folder / transfer.sent_file)
    return Measures(
        sent_bytes=None if sent is None else len(sent),
        received_bytes=None if received is None else len(received),
        file_loss=None if sent is None or received is None else loss(len(received), len(sent)),
        hash_match=None if sent is None or received is None else sent == received,
        bag_messages=contents.messages if contents else None,
        bag_duration_s=contents.duration_s if contents else None,
    )


def _captures(folder: Path, sender: pcap.Capture | None, receiver: pcap.Capture | None) -> Measures:
    sender_log = _known(tcpdump_log.read, folder / reading.SENDER_CAPTURE_LOG)
    receiver_log = _known(tcpdump_log.read, folder / reading.RECEIVER_CAPTURE_LOG)
    return Measures(
        sender_captured=sender.frames if sender else None,
        sender_capture_dropped=sender_log.dropped_by_kernel if sender_log else None,
        receiver_captured=receiver.frames if receiver else None,
        receiver_capture_dropped=receiver_log.dropped_by_kernel if receiver_log else None,
    )


def _layers(sender: pcap.Capture | None, receiver: pcap.Capture | None, transfer: Transfer) -> Iterator[Measures]:
    if sender is None or receiver is None:
        return
    try:
        yield from layers.measure(sender.packets, receiver.packets, transfer)
    except EvidenceError:  # as for a damaged capture
        return


def _round_trips(pings: ping.Ping | None) -> Measures:
    # Without its first line ping never ran: no answer is then no measurement.
    if pings is None or pings.payload_bytes is None:
        return Measures()
    counts = Measures(
        rtt_sent=pings.transmitted,
        rtt_received=len(pings.answers),
        rtt_loss=loss(len(pings.answers), pings.transmitted),
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
        rtt_jitter_s=float(np.abs(np.diff(rtt_s)).mean()) if len(rtt_s) > 1 else None,
    )


def _air(folder: Path) -> Measures:
    parts = _known(medium.read, folder / reading.MEDIUM)
    if parts is None:
        return Measures()
    if not parts.packets:
        return Measures(delay_packets=0)
    scale = 1e9 * parts.packets
    return Measures(
        delay_s=medium.total_ns(parts) / scale,
        delay_processing_s=parts.processing_ns / scale,
        delay_transmission_s=parts.transmission_ns / scale,
        delay_propagation_s=parts.propagation_ns / scale,
        delay_queuing_s=parts.queuing_ns / scale,
        delay_packets=parts.packets,
    )


def _lateness(folder: Path) -> Measures:
    found = _known(lateness.read, folder / reading.LATENESS)
    if found is None:
        return Measures()
    late_ns = {share: lateness.quantile_ns(found, share) for share in (0.99, 1.0)}
    return Measures(
        emulator_late_p99_s=None if late_ns[0.99] is None else late_ns[0.99] / 1e9,
        emulator_late_max_s=None if late_ns[1.0] is None else late_ns[1.0] / 1e9,
        emulator_too_late=lateness.too_late(found),
    )


def _apart(folder: Path, prefix: str, times_ns: Collection[int]) -> Measures:
    """Return how far sender and receiver were apart from the first of some times to the last.

    They are by a robot's clock, which is taken for the laptop's: it is, where a lab knows where robots are.
    """
    where = _known(track.read, folder / reading.TRACK)
    if where is None or not len(times_ns) or NO_TIME in times_ns:
        return Measures()
    apart = track.apart(where, min(times_ns), max(times_ns))
    if apart is None:
        return Measures()
    return Measures(**{f"{prefix}_{item.name}": getattr(apart, item.name) for item in fields(apart)})


def _sent_ns(sender: pcap.Capture | None, transfer: Transfer) -> list[int]:
    """Return when each packet of the transfer that names its port was sent."""
    if sender is None:
        return []
    sent = transfer.forward(sender.packets)
    times_ns: list[int] = sent.time_ns[sent.dport == transfer.port].tolist()
    return times_ns


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
        paper_loss=loss(received, sent),
    )


def _fault(folder: Path, kind: FaultKind) -> Measures:
    found = _known(lambda path: recovery.read(path, kind), folder)
    if found is None:
        return Measures()
    return Measures(**{of_fault(kind, item.name): getattr(found, item.name) for item in fields(found)})


def _host(folder: Path) -> Measures:
    before = _known(host.read, folder / reading.RECEIVER_BEFORE)
    after = _known(host.read, folder / reading.RECEIVER_AFTER)
    if before is None or after is None:
        return Measures()
    moved = host.difference(before, after)
    return Measures(
        receiver_udp_buffer_errors=moved.udp_buffer_errors,
        receiver_reassembly_failures=moved.reassembly_failures,
    )
