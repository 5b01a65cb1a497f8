"""All columns of one transfer, computed from files, captures, the output of ping, and counters of the hosts.

*The paper* is the publication whose field trials fieldkit automates (docs/index.md). The columns `paper_*` are
computed as in the paper, for comparison with the columns of fieldkit. The paper's filters are tcpdump's
`src SENDER and port P` at the sender and `dst RECEIVER and port P` at the receiver. `port` matches the source or
destination port of TCP, UDP or SCTP (pcap-filter(7)), so later fragments do not match.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from fieldkit.core.columns import Measured, Value, step_prefixed
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import NO_TIME, Mask
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import host, oracle_delays, ping, reading, recordings
from fieldkit.measure.positions import position_columns
from fieldkit.measure.transfers import altered_packets, delay, rates, stalls, tcp, udp
from fieldkit.measure.transfers.deliveries import FlowSchedule
from fieldkit.measure.transfers.transfer_columns import DISTANCE, LAYERS, OF_TCP, OF_UDP, STALLS, TIMES
from fieldkit.measure.transfers.transfer_spec import Transfer

PAPER_WINDOW_BYTES: Final[Mapping[Protocol, int]] = MappingProxyType({Protocol.TCP: 502, Protocol.UDP: 8192})
"""Payload of a ping that the paper uses as the window of each protocol."""

PAPER_COUNTS: Final = ("paper_packets", "paper_received", "paper_loss", "paper_transfer_s")
"""Columns that depend on the counts of the paper's filters, which may include packets of other transfers."""


def paper_frames_from(packets: Packets, address: str, port: int) -> int:
    """Return the number of packets that match `src ADDRESS and port PORT`."""
    return int((packets.are_from(address) & _has_port(packets, port)).sum())


def paper_frames_to(packets: Packets, address: str, port: int) -> int:
    """Return the number of packets that match `dst ADDRESS and port PORT`."""
    return int((packets.are_to(address) & _has_port(packets, port)).sum())


def paper_transfer_s(packets: int, delay_s: float) -> float:
    """Return the paper's transfer time: number of packets times the mean RTT of pings with `PAPER_WINDOW_BYTES`."""
    return packets * delay_s


def _has_port(packets: Packets, port: int) -> Mask:
    matches: Mask = (packets.sport == port) | (packets.dport == port)
    return matches


def measure(evidence: AttemptEvidence, transfer: Transfer, listener: str = "") -> Measured:
    """Return all columns of a transfer.

    Columns that depend on missing, unreadable or damaged evidence are missing. Other checks, the gates, decide
    whether the repeat is valid without these columns.

    Args:
        evidence: The attempt's evidence.
        transfer: The transfer.
        listener: Name of the job that received the file; empty if unknown.
    """
    captures = [evidence.undamaged_capture(file) for file in transfer.captures]
    sender, receiver = captures if transfer.captured else (None, None)
    contradiction = incomparability_reason(evidence, transfer)
    ping_output = evidence.read_or_none(ping.read, step_prefixed(transfer.name, ping.FILE))
    states = (host.before_file(transfer.destination), host.after_file(transfer.destination))
    files = _files(evidence, transfer)
    air_delay = evidence.read_or_none(
        oracle_delays.read_air_delay, step_prefixed(transfer.name, oracle_delays.AIR_DELAY_FILE)
    )
    return (
        files
        | _layers(
            (sender, receiver),
            transfer,
            files,
            contradiction,
            stalls.flow_schedule(evidence, transfer, listener),
        )
        | oracle_delays.measure_air_delay(air_delay)
        | oracle_delays.measure_policy_delay(air_delay)
        | position_columns.measure(
            evidence, DISTANCE, (transfer.source, transfer.destination), _sent_ns(sender, transfer)
        )
        | _paper(sender, None if contradiction else receiver, ping_output, transfer)
        | host.measure(*(evidence.read_or_none(host.read_counters, name) for name in states))
        | _system(evidence, transfer)
    )


def _system(evidence: AttemptEvidence, transfer: Transfer) -> Measured:
    """Return the columns of the hosts' operating systems."""
    if transfer.protocol is Protocol.UDP:
        return Measured.all_missing(host.SYSTEM, "UDP has no congestion control")
    return host.measure_system(evidence.read_or_none(host.congestion_control, host.before_file(transfer.source)))


def incomparability_reason(evidence: AttemptEvidence, transfer: Transfer) -> str | None:
    """Return the reason why no loss can be computed from two undamaged captures, or None if it can be computed.

    The reason is a contradiction between the two captures, or between a capture and the received file. The result is
    None if an end has no capture; a damaged capture is not compared.
    """
    return evidence.cached(_incomparability_reason, transfer) if transfer.captured else None


def _incomparability_reason(evidence: AttemptEvidence, transfer: Transfer) -> str | None:
    sender, receiver = map(evidence.undamaged_capture, transfer.captures)
    if (
        sender
        and receiver
        and (reason := altered_packets.incomparability_reason(sender.packets, receiver.packets, transfer))
    ):
        return f"the captures of the transfer cannot be compared: {reason}"
    if evidence.read_or_none(reading.size, transfer.received_file):
        for role, capture in ((transfer.source, sender), (transfer.destination, receiver)):
            if capture is not None and not len(transfer.forward(capture.packets)):
                return (
                    f"{transfer.received_file} is not empty, but the capture of {role} has no packet of the transfer:"
                    " check if a router on the path translates addresses (NAT)"
                )
    return None


def loss(arrived: int | None, sent: int | None) -> float | None:
    """Return the loss 1 - arrived/sent (eq. 1 of the paper), or None if nothing was sent or a number is unknown."""
    return None if arrived is None or not sent else 1 - arrived / sent


def _files(evidence: AttemptEvidence, transfer: Transfer) -> Measured:
    """Return the columns of the sent and the received file."""
    sent_bytes = evidence.read_or_none(reading.size, transfer.sent_file)
    received_bytes = evidence.read_or_none(reading.size, transfer.received_file)
    contents = evidence.read_or_none(recordings.read, transfer.sent_file)
    files: dict[str, Value | None] = {
        "sent_bytes": sent_bytes,
        "received_bytes": received_bytes,
        "file_loss": loss(received_bytes, sent_bytes),
        "hash_match": evidence.read_or_none(reading.have_equal_bytes, "", transfer.sent_file, transfer.received_file),
    }
    messages: dict[str, Value | None] = {
        "bag_messages": contents.messages if contents else None,
        "bag_duration_s": contents.duration_s if contents else None,
    }
    return Measured.from_optional(files, "the file is missing or empty") | Measured.from_optional(
        messages, "the sent file is not a bag"
    )


def _layers(
    ends: tuple[Capture | None, Capture | None],
    transfer: Transfer,
    files: Measured,
    contradiction: str | None,
    schedule: FlowSchedule,
) -> Measured:
    """Return the columns that depend on both captures: losses, delay, stalls, and rates."""
    all_columns = (*LAYERS, *delay.COLUMNS, *delay.SENT_COLUMNS, *rates.COLUMNS, *STALLS)
    sender, receiver = ends
    if contradiction:
        return Measured({"one_way_withheld": contradiction}) | Measured.all_missing(all_columns, contradiction)
    if sender is None or receiver is None:
        return Measured.all_missing(all_columns, "there are no complete captures of both ends")
    try:
        if transfer.protocol is Protocol.UDP:
            udp_packets = udp.match_transfer(sender.packets, receiver.packets, transfer)
            udp_counts = udp.count(udp_packets)
            pairs, counts, sent = delay.udp_pairs(udp_packets), _udp_values(udp_counts), udp_counts.packets_sent
            transfer_rates = rates.udp_rates(udp_packets)
            stall_columns = stalls.measure("transfer", lambda: stalls.udp_deliveries(udp_packets, schedule))
        else:
            frames = tcp.match_transfer(sender.packets, receiver.packets, transfer)
            tcp_counts = tcp.count(frames)
            pairs, counts, sent = delay.tcp_pairs(frames), _tcp_values(tcp_counts), delay.count_tcp_sent(frames)
            transfer_rates = rates.tcp_rates(frames, receiver.packets, transfer, tcp_counts)
            reverse = transfer.backward(sender.packets)
            stall_columns = stalls.measure("transfer", lambda: stalls.tcp_deliveries(frames, reverse, schedule))
        ambiguous = bool(counts.get("ip_packets_doubtful") or counts.get("tcp_doubtful_segments"))
        delays = delay.measure(pairs, sender.packets, receiver.packets, transfer, sent=sent or 0, ambiguous=ambiguous)
    except EvidenceError as error:  # captures that cannot be evaluated are treated like damaged captures
        return Measured.all_missing(all_columns, error.what)
    rate_values = transfer_rates.values(files.values.get("received_bytes"))
    if delays.values.get("one_way_withheld") == delay.UNSTEADY:
        delays |= Measured.all_missing((*TIMES, *rates.COLUMNS), delay.UNSTEADY)
        stall_columns = Measured.all_missing(STALLS, delay.UNSTEADY)
        counts, rate_values = (
            {name: value for name, value in values.items() if name not in delays.missing}
            for values in (counts, rate_values)
        )
    other_names = OF_TCP if transfer.protocol is Protocol.UDP else OF_UDP
    other_columns = [column for column in LAYERS if column.name in other_names]
    reason = "no such packet was sent or arrived, or it is ambiguous which packets arrived"
    count_columns = Measured.from_optional(counts, reason)
    rate_columns = Measured.from_optional(
        rate_values, "the captures have fewer than two packets of the transfer, or lack its end"
    )
    other_protocol_columns = Measured.all_missing(other_columns, f"not applicable to {transfer.protocol}")
    return delays | count_columns | rate_columns | stall_columns | other_protocol_columns


def _udp_values(counts: udp.UdpCounts) -> dict[str, Value | None]:
    sent: dict[str, Value | None] = {
        "ip_packets_sent": counts.packets_sent,
        "ip_packets_doubtful": counts.packets_ambiguous,
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
    # Each received packet that may be a copy may hide the loss of another packet.
    return sent | (dict.fromkeys(received) if counts.possible_copies else received)


def _tcp_values(counts: tcp.TcpCounts) -> dict[str, Value | None]:
    received_bytes = None if counts.possible_copies else counts.received_bytes
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
        "tcp_doubtful_segments": counts.ambiguous_frames,
        "tcp_superframes": counts.superframes,
        "transfer_s": counts.transfer_s,
        "transfer_from": None if counts.transfer_s is None else "receiver",
    }


def _sent_ns(sender: Capture | None, transfer: Transfer) -> list[int]:
    """Return the time of sending of each packet with the transfer's port; empty if a time is missing."""
    if sender is None:
        return []
    sent = transfer.forward(sender.packets)
    times_ns: list[int] = sent.time_ns[sent.dport == transfer.port].tolist()
    return [] if NO_TIME in times_ns else times_ns


def _paper(
    sender: Capture | None, receiver: Capture | None, ping_output: ping.Ping | None, transfer: Transfer
) -> Measured:
    """Return the columns `paper_*`."""
    window_bytes = PAPER_WINDOW_BYTES[transfer.protocol]
    sent = paper_frames_from(sender.packets, transfer.sender_address, transfer.port) if sender else None
    received = paper_frames_to(receiver.packets, transfer.receiver_address, transfer.port) if receiver else None
    rtt_s = ping_output.rtt_s if ping_output and ping_output.payload_bytes == window_bytes else ()
    delay_s = float(np.mean(rtt_s)) if rtt_s else None
    frames: dict[str, Value | None] = {
        "paper_packets": sent,
        "paper_received": received,
        "paper_window_bytes": window_bytes,
        "paper_loss": loss(received, sent),
    }
    times: dict[str, Value | None] = {
        "paper_delay_s": delay_s,
        "paper_transfer_s": None if sent is None or delay_s is None else paper_transfer_s(sent, delay_s),
    }
    return Measured.from_optional(
        frames, "there are no complete captures of both ends, or nothing was sent"
    ) | Measured.from_optional(times, f"no reply to a ping of {window_bytes} bytes has a time")
