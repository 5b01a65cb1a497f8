"""The figures of one transfer: from files, captures, ping and host to the columns that it declares."""

import numpy as np

from fieldkit.core.columns import Measured, Value, prefixed
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import bag, host, medium, ping, reading
from fieldkit.measure.positions import where
from fieldkit.measure.transfers import delay, paper, rates, stalls, strangers, tcp, transfer_stalls, udp
from fieldkit.measure.transfers.columns import LAYERS, OF_TCP, OF_UDP, STALLS, TIMES, WAY
from fieldkit.measure.transfers.deliveries import FlowSchedule
from fieldkit.measure.transfers.transfer import Transfer


def measure(evidence: AttemptEvidence, transfer: Transfer, listener: str = "") -> Measured:
    """Return every figure of a transfer.

    What rests on missing, unreadable or damaged evidence is missing, never a guess; whether the repeat is valid
    without it is for the gates to say.

    Args:
        evidence: What the attempt left.
        transfer: What was sent from where to where.
        listener: Job that received it; empty where that is not known.
    """
    whole = [evidence.whole_capture(file) for file in transfer.captures]
    sender, receiver = whole if transfer.captured else (None, None)
    contradiction = incomparable(evidence, transfer)
    pings = evidence.read_or_none(ping.read, prefixed(transfer.name, ping.FILE))
    states = (host.before(transfer.destination), host.after(transfer.destination))
    files = _files(evidence, transfer)
    return (
        files
        | _layers(
            (sender, receiver), transfer, files, contradiction, transfer_stalls.expected(evidence, transfer, listener)
        )
        | medium.measure(evidence.read_or_none(medium.read, prefixed(transfer.name, medium.FILE)))
        | where.measure(evidence, WAY, (transfer.source, transfer.destination), _sent_ns(sender, transfer))
        | _paper(sender, None if contradiction else receiver, pings, transfer)
        | host.measure(*(evidence.read_or_none(host.read, name) for name in states))
        | _system(evidence, transfer)
    )


def _system(evidence: AttemptEvidence, transfer: Transfer) -> Measured:
    """Return what is known of the operating systems of both ends."""
    if transfer.protocol is Protocol.UDP:
        return Measured.nothing(host.SYSTEM, "UDP has no congestion control")
    return host.measure_system(evidence.read_or_none(host.congestion_control, host.before(transfer.source)))


def incomparable(evidence: AttemptEvidence, transfer: Transfer) -> str | None:
    """Return why no loss can be told from two whole captures, None where one can or where there are not both.

    They contradict the file, or each other.
    """
    return evidence.cached(_incomparable, transfer) if transfer.captured else None


def _incomparable(evidence: AttemptEvidence, transfer: Transfer) -> str | None:
    sender, receiver = map(evidence.whole_capture, transfer.captures)
    if sender and receiver and (why := strangers.reason(sender.packets, receiver.packets, transfer)):
        return f"the captures of the transfer do not compare: {why}"
    if evidence.read_or_none(reading.size, transfer.received_file):
        for role, capture in ((transfer.source, sender), (transfer.destination, receiver)):
            if capture is not None and not len(transfer.forward(capture.packets)):
                return (
                    f"{transfer.received_file} has bytes, and no packet of the transfer is in the capture of {role}:"
                    " is an address translated on the way?"
                )
    return None


def loss(arrived: int | None, sent: int | None) -> float | None:
    """Return 1 - arrived/sent, the loss of the paper's eq. 1; None when nothing was sent."""
    return None if arrived is None or not sent else 1 - arrived / sent


def _files(evidence: AttemptEvidence, transfer: Transfer) -> Measured:
    sent = evidence.read_or_none(reading.size, transfer.sent_file)
    received = evidence.read_or_none(reading.size, transfer.received_file)
    contents = evidence.read_or_none(bag.read, transfer.sent_file)
    files: dict[str, Value | None] = {
        "sent_bytes": sent,
        "received_bytes": received,
        "file_loss": loss(received, sent),
        "hash_match": evidence.read_or_none(reading.same, "", transfer.sent_file, transfer.received_file),
    }
    messages: dict[str, Value | None] = {
        "bag_messages": contents.messages if contents else None,
        "bag_duration_s": contents.duration_s if contents else None,
    }
    return Measured.of(files, "the file is not at hand, or empty") | Measured.of(messages, "what was sent is no bag")


def _layers(
    ends: tuple[Capture | None, Capture | None],
    transfer: Transfer,
    files: Measured,
    contradiction: str | None,
    expected: FlowSchedule,
) -> Measured:
    """Return what the packets of both captures say of a transfer: losses, delay, stalls, and how fast it was."""
    declared = (*LAYERS, *delay.COLUMNS, *delay.SENT_COLUMNS, *rates.COLUMNS, *STALLS)
    sender, receiver = ends
    if contradiction:
        return Measured({"one_way_withheld": contradiction}) | Measured.nothing(declared, contradiction)
    if sender is None or receiver is None:
        return Measured.nothing(declared, "there are no whole captures of both ends")
    try:
        if transfer.protocol is Protocol.UDP:
            crossing = udp.cross(sender.packets, receiver.packets, transfer)
            packets = udp.count(crossing)
            own, counts, sent = delay.udp_packets(crossing), _udp(packets), packets.packets_sent
            speed = rates.of_udp(crossing)
            stalled = stalls.measure("transfer", lambda: transfer_stalls.of_udp(crossing, expected))
        else:
            frames = tcp.cross(sender.packets, receiver.packets, transfer)
            counted = tcp.count(frames)
            own, counts, sent = delay.tcp_frames(frames), _tcp(counted), delay.tcp_sent(frames)
            speed = rates.of_tcp(frames, receiver.packets, transfer, counted)
            back = transfer.backward(sender.packets)
            stalled = stalls.measure("transfer", lambda: transfer_stalls.of_tcp(frames, back, expected))
        alike = bool(counts.get("ip_packets_doubtful") or counts.get("tcp_doubtful_segments"))
        delays = delay.measure(own, sender.packets, receiver.packets, transfer, sent=sent or 0, alike=alike)
    except EvidenceError as error:  # as for a damaged capture
        return Measured.nothing(declared, error.what)
    fast_values = speed.values(files.values.get("received_bytes"))
    if delays.values.get("one_way_withheld") == delay.UNSTEADY:
        delays |= Measured.nothing((*TIMES, *rates.COLUMNS), delay.UNSTEADY)
        stalled = Measured.nothing(STALLS, delay.UNSTEADY)
        counts, fast_values = (
            {name: value for name, value in told.items() if name not in delays.missing}
            for told in (counts, fast_values)
        )
    foreign = OF_TCP if transfer.protocol is Protocol.UDP else OF_UDP
    others = [column for column in LAYERS if column.name in foreign]
    own_figures = Measured.of(counts, "no such packet was sent, none arrived, or it is in doubt which of them did")
    fast = Measured.of(fast_values, "no two packets, or not the end, of the transfer were seen")
    return delays | own_figures | fast | stalled | Measured.nothing(others, f"{transfer.protocol} has none")


def _udp(counts: udp.UdpCounts) -> dict[str, Value | None]:
    sent: dict[str, Value | None] = {
        "ip_packets_sent": counts.packets_sent,
        "ip_packets_doubtful": counts.packets_doubtful,
        "datagrams_sent": counts.datagrams_sent,
        "transfer_s": counts.transfer_s,
        "transfer_from": None if counts.transfer_s is None else "receiver",
    }
    received: dict[str, Value | None] = {
        "ip_packets_received": counts.packets_received,
        "ip_loss": loss(counts.packets_received, counts.packets_sent),
        "ip_packets_duplicated": counts.packets_duplicated,
        "ip_packets_reordered": counts.packets_reordered,
        "ip_loss_bursts": counts.loss_bursts,
        "ip_loss_longest_burst": counts.longest_burst,
        "datagrams_received": counts.datagrams_received,
        "datagram_loss": loss(counts.datagrams_received, counts.datagrams_sent),
        "byte_loss": loss(counts.bytes_received, counts.bytes_sent),
    }
    # As many losses may hide behind copies that cannot be told from packets that were sent.
    return sent | (dict.fromkeys(received) if counts.packets_dubious else received)


def _tcp(counts: tcp.TcpCounts) -> dict[str, Value | None]:
    received_bytes = None if counts.dubious_frames else counts.received_bytes
    return {
        "ip_packets_sent": counts.frames_sent,
        "ip_packets_received": counts.frames_received,
        "byte_loss": loss(counts.unique_bytes - counts.lost_bytes, counts.unique_bytes),
        "tcp_sent_bytes": counts.sent_bytes,
        "tcp_unique_bytes": counts.unique_bytes,
        "tcp_received_bytes": received_bytes,
        "tcp_byte_loss": loss(received_bytes, counts.sent_bytes),
        "tcp_retransmitted_segments": counts.retransmitted_frames,
        "tcp_spurious_segments": counts.spurious_frames,
        "tcp_duplicated_bytes": counts.duplicated_bytes,
        "tcp_reordered_segments": counts.reordered_frames,
        "tcp_doubtful_segments": counts.doubtful_frames,
        "tcp_superframes": counts.superframes,
        "transfer_s": counts.transfer_s,
        "transfer_from": None if counts.transfer_s is None else "receiver",
    }


def _sent_ns(sender: Capture | None, transfer: Transfer) -> list[int]:
    """Return when each packet of the transfer that names its port was sent; none where a time is missing."""
    if sender is None:
        return []
    sent = transfer.forward(sender.packets)
    times_ns: list[int] = sent.time_ns[sent.dport == transfer.port].tolist()
    return [] if NO_TIME in times_ns else times_ns


def _paper(sender: Capture | None, receiver: Capture | None, pings: ping.Ping | None, transfer: Transfer) -> Measured:
    window_bytes = paper.WINDOW_BYTES[transfer.protocol]
    sent = paper.frames_from(sender.packets, transfer.sender_address, transfer.port) if sender else None
    received = paper.frames_to(receiver.packets, transfer.receiver_address, transfer.port) if receiver else None
    rtt_s = pings.rtt_s if pings and pings.payload_bytes == window_bytes else ()
    delay_s = float(np.mean(rtt_s)) if rtt_s else None
    frames: dict[str, Value | None] = {
        "paper_packets": sent,
        "paper_received": received,
        "paper_window_bytes": window_bytes,
        "paper_loss": loss(received, sent),
    }
    times: dict[str, Value | None] = {
        "paper_delay_s": delay_s,
        "paper_transfer_s": None if sent is None or delay_s is None else paper.transfer_s(sent, delay_s),
    }
    return Measured.of(frames, "there are no whole captures of both ends, or nothing was sent") | Measured.of(
        times, f"no reply to a ping of {window_bytes} bytes has a time"
    )
