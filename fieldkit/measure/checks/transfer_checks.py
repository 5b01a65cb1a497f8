"""Contradictions between the two captures and the two files of a transfer, and the sources of its columns.

A contradiction shows that a capture or a file is incomplete. Losses, duplicates, reordering and clock offsets cause
no contradiction.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.model import Protocol
from fieldkit.core.units import format_count
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.arrays import Keys, row_hashes
from fieldkit.measure.captures.packets import NO_PORT, RST, SYN, UDP_HEADER_BYTES, Packets
from fieldkit.measure.checks import udp_file_checks
from fieldkit.measure.evidence import reading
from fieldkit.measure.transfers.tcp_streams import LONGEST_BYTES, Connections
from fieldkit.measure.transfers.transfer_spec import Transfer


@dataclass(frozen=True)
class _Files:
    """Sizes of both files of a transfer, and the length of their common prefix."""

    sent_bytes: int
    received_bytes: int
    common_bytes: int

    @property
    def are_equal(self) -> bool:
        return self.sent_bytes == self.received_bytes == self.common_bytes


def find_contradictions(
    evidence: AttemptEvidence, transfer: Transfer, *, finished: bool, was_stopped: bool = False
) -> Iterator[str]:
    """Yield each contradiction as a sentence. Files and captures that are missing or damaged are not compared.

    Args:
        evidence: The attempt's evidence.
        transfer: The transfer.
        finished: True if the evidence shows that the listener, the receiving program, exited without being stopped.
        was_stopped: True if the evidence shows that the listener was stopped before it had finished.
    """
    files = _files(evidence, transfer)
    if files and transfer.protocol is Protocol.TCP and files.common_bytes < files.received_bytes:
        yield f"{transfer.received_file} is not a prefix of {transfer.sent_file}, although TCP does not alter bytes"
    sender, receiver = map(evidence.undamaged_capture, transfer.captures)
    if sender is None or receiver is None:
        return
    if earlier_packets := _earlier_traffic(sender.packets, receiver.packets, transfer):
        yield f"packets of an earlier attempt were still in transit: {earlier_packets}"
    elif transfer.protocol is Protocol.UDP:
        size_problems = list(_udp_contradictions(sender.packets, receiver.packets, files, transfer))
        yield from size_problems or udp_file_checks.find_contradictions(
            evidence, transfer, sender.packets, receiver.packets, was_stopped=was_stopped
        )
    elif files is None or max(files.sent_bytes, files.received_bytes) < LONGEST_BYTES:
        yield from _tcp_contradictions(sender.packets, receiver.packets, files, transfer, finished=finished)


def _files(evidence: AttemptEvidence, transfer: Transfer) -> _Files | None:
    sent_bytes = evidence.read_or_none(reading.size, transfer.sent_file)
    received_bytes = evidence.read_or_none(reading.size, transfer.received_file)
    common_bytes = evidence.read_or_none(reading.common_prefix_bytes, "", transfer.sent_file, transfer.received_file)
    if sent_bytes is None or received_bytes is None or common_bytes is None:
        return None
    return _Files(sent_bytes, received_bytes, common_bytes)


def _earlier_traffic(sender: Packets, receiver: Packets, transfer: Transfer) -> str | None:
    """Return a description of packets of an earlier transfer, or None if there are none.

    A sending netcat uses one source port per transfer. Packets are from an earlier transfer if they arrive with
    payload from a source port that is missing in the sender's capture, or if the sender sent them from another port
    than the transfer that started last. Over TCP, a SYN marks the start of a transfer, because retransmissions of an
    aborted connection contain no SYN.
    """
    sent, received = (
        packets.where(packets.dport == transfer.port) for packets in map(transfer.forward, (sender, receiver))
    )
    has_payload = (received.tcp_payload_bytes > 0) | (received.udp_bytes > 0)
    if stray := int((has_payload & ~np.isin(received.sport, sent.sport)).sum()):
        packets_text = f"{format_count(stray, 'packet')} arrived at the transfer's port"
        return f"{packets_text} from source ports that are not in the {transfer.source}'s capture"
    starts = sent if transfer.protocol is Protocol.UDP else sent.where(sent.tcp_flags & SYN != 0)
    ports, first = np.unique(starts.sport, return_index=True)
    if len(ports) > 1:
        delayed = int((starts.sport != ports[first.argmax()]).sum())
        return f"{format_count(delayed, 'packet')} to the transfer's port left before the transfer started"
    return None


def _byte_count_contradictions(
    files: _Files, captured_bytes: int, arrived_bytes: int, transfer: Transfer
) -> Iterator[str]:
    """Yield contradictions between the sizes of the files and the number of bytes in the captures."""
    if captured_bytes > files.sent_bytes:
        yield f"{captured_bytes} bytes left the {transfer.source}, but {transfer.sent_file} has {files.sent_bytes}"
    if files.received_bytes > arrived_bytes:
        capture_text = f"the {transfer.destination}'s capture contains {arrived_bytes} bytes of the transfer"
        yield f"{capture_text}, but {transfer.received_file} has {files.received_bytes}"


def _udp_contradictions(
    sender: Packets, receiver: Packets, files: _Files | None, transfer: Transfer
) -> Iterator[str]:
    """Yield contradictions between the datagrams in both captures and the files' sizes."""
    both = transfer.forward(sender), transfer.forward(receiver)
    # A capture also contains later fragments of other programs' datagrams.
    ids = np.concatenate([packets.ip_id[packets.dport == transfer.port] for packets in both])
    sent, received = (
        packets.where((packets.dport == transfer.port) | (packets.dport == NO_PORT) & np.isin(packets.ip_id, ids))
        for packets in both
    )
    is_first, is_first_received = sent.dport == transfer.port, received.dport == transfer.port
    keys, keys_received = _packet_keys(sent), _packet_keys(received)
    if unsent := int((~np.isin(keys_received[is_first_received], keys[is_first])).sum()):
        yield f"the {transfer.source}'s capture lacks {format_count(unsent, 'datagram')} that arrived"
    if files is None:
        return
    # The number of arrived bytes is at most the sum of the UDP lengths in the first fragments, and at most the sum of
    # the payloads of all fragments.
    udp_bytes = received.udp_bytes[is_first_received]
    arrived_bytes = min(int(udp_bytes.sum()), int(received.ip_payload_bytes.sum())) - UDP_HEADER_BYTES * len(
        udp_bytes
    )
    sent_bytes = int((sent.udp_bytes[is_first] - UDP_HEADER_BYTES).sum())
    yield from _byte_count_contradictions(files, sent_bytes, arrived_bytes, transfer)
    # Copies can compensate for missing packets in the sum of bytes, so the packets are also compared individually.
    # A later fragment cannot be assigned if another transfer uses the same id.
    other_ids = np.concatenate(
        [packets.ip_id[(packets.dport != transfer.port) & (packets.dport != NO_PORT)] for packets in both]
    )
    is_assignable = is_first | ~np.isin(sent.ip_id, other_ids)
    missing = int((~np.isin(keys[is_assignable], keys_received)).sum())
    if missing and files.are_equal and files.received_bytes <= arrived_bytes:
        missing_text = f"lacks {format_count(missing, 'packet')} of it"
        yield f"{transfer.received_file} is complete, but the {transfer.destination}'s capture {missing_text}"


def _packet_keys(packets: Packets) -> Keys:
    """Return a key of each packet, which is the same at both ends and practically unique."""
    return row_hashes(packets.ip_id << 16 | packets.fragment_offset, packets.ip_payload_bytes, packets.sport + 1)


def _tcp_contradictions(
    sender: Packets, receiver: Packets, files: _Files | None, transfer: Transfer, *, finished: bool
) -> Iterator[str]:
    """Yield contradictions between the bytes in both captures, TCP's acknowledgments and the files' sizes."""
    sent, received = (
        packets.where(packets.dport == transfer.port)
        for packets in (transfer.forward(sender), transfer.forward(receiver))
    )
    answers_received, answers_sent = (
        packets.where(packets.sport == transfer.port)
        for packets in (transfer.backward(sender), transfer.backward(receiver))
    )
    if _is_refused(sent, answers_received):
        refusal = f"the {transfer.destination} refused the connection"
        yield f"{refusal}: no program was listening when the {transfer.source} started"
        return
    connections_by_role = {
        transfer.source: Connections.from_syn(sent),
        transfer.destination: Connections.from_syn(received),
    }
    data_ports = np.unique(received.sport[received.tcp_payload_bytes > 0])
    has_syn = {role: connections.includes(data_ports) for role, connections in connections_by_role.items()}
    for role, role_has_syn in has_syn.items():
        # If the SYN is in neither capture, the packets are retransmissions of an earlier transfer.
        if (~role_has_syn & np.logical_or(*has_syn.values())).any():
            yield f"bytes arrived on a connection whose SYN is not in the {role}'s capture"
            return
    connections = connections_by_role[transfer.source]
    if unsent := connections.payload(received).bytes_not_in(connections.payload(sent)):
        yield f"the {transfer.source}'s capture lacks {format_count(unsent, 'byte')} that arrived"
    answers = Packets.concatenated((answers_received, answers_sent))
    acknowledged = connections.acknowledged(answers)
    for packets, role in ((sent, transfer.source), (received, transfer.destination)):
        if missing := acknowledged.bytes_not_in(connections.numbers(packets)):
            yield f"{format_count(missing, 'byte')} were acknowledged, but are not in the {role}'s capture"
    if files is None:
        return
    arrived_bytes = connections.payload(received).size_bytes
    yield from _byte_count_contradictions(files, connections.payload(sent).size_bytes, arrived_bytes, transfer)
    is_acknowledged = not connections.numbers(sent).bytes_not_in(acknowledged)
    # If a program stops reading before the end of the stream, the kernel rejects the later bytes with a reset.
    is_reset = (answers.tcp_flags & RST != 0).any()
    if finished and (is_acknowledged or is_reset) and files.received_bytes < arrived_bytes:
        arrived_text = f"{arrived_bytes} bytes arrived, but {transfer.received_file} has {files.received_bytes}"
        yield f"{arrived_text}, although its listener exited normally"


def _is_refused(sent: Packets, answers: Packets) -> bool:
    """Return True if the receiver refused the only SYN and accepted no connection.

    A reset after several SYNs is not a refusal, because the link may have lost the first SYN or its answer.
    """
    resets = answers.where(answers.tcp_flags & RST != 0)
    if not len(resets) or (answers.tcp_flags & SYN != 0).any():
        return False
    syn_packets = sent.where((sent.tcp_flags & SYN != 0) & (sent.time_ns <= resets.time_ns.min()))
    return len(syn_packets) == 1


CROSS_CHECKS: Final = (
    udp_file_checks.CROSS_CHECK,
    CrossCheck(
        quantity="file received over TCP",
        columns=("received_bytes", "file_loss", "hash_match", "goodput_bit_s", "completion_s"),
        source="`recv.bag`",
        against=(
            "`scan.bag`: its first bytes",
            "both captures: bytes that arrived",
            "exit code of the listener",
        ),
        tolerance="the file may lack bytes that the listener did not read before its time limit",
    ),
    CrossCheck(
        quantity="file sent",
        columns=("sent_bytes", "bag_messages", "bag_duration_s"),
        source="`scan.bag`",
        against=("sender's capture: bytes that left", "the procedure: topics and duration"),
        tolerance=(
            "a bag may be shorter than planned by half of the planned duration plus 1 s, because a recorder needs "
            "time to subscribe"
        ),
    ),
    CrossCheck(
        quantity="packets sent and received",
        columns=(
            *("ip_*", "datagram*", "byte_loss", "tcp_*", "paper_packets", "paper_received", "paper_loss"),
            *("transfer_s", "transfer_from", "throughput_bit_s", "paper_window_bytes"),
        ),
        source="`sender.pcap`, `receiver.pcap`",
        against=("each other", "`ROLE-capture.log`: tcpdump's counters", "TCP's acknowledgments", "both files"),
        tolerance="none; losses, copies and reordering on the link are not contradictions",
    ),
    CrossCheck(
        quantity="delay and its variation",
        columns=("one_way_*", "delay_variation_*", "jitter_s", "clock_*"),
        source="times in `sender.pcap` and `receiver.pcap`",
        against=("packets in both directions: offset and skew of the clocks", "each robot's clock before and after"),
        tolerance=(
            "the error bound of the clock offset (valid even if one time stamp is wrong) may be at most a tenth of "
            "the delay; the clocks must advance at constant rates"
        ),
        outcome=CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        quantity="the paper's delay",
        columns=("paper_delay_s", "paper_transfer_s"),
        source="`ping.txt`: `time=`",
        against=("the sources with which the round-trip times of the step `ping` are compared",),
        tolerance="the same as for the step `ping`",
    ),
    CrossCheck(
        quantity="datagrams that the kernel refused",
        columns=("receiver_udp_buffer_errors", "receiver_reassembly_failures"),
        source="`ROLE-before.txt`, `ROLE-after.txt`: /proc/net/snmp",
        against=(),
        tolerance="only the kernel counts them; the column is empty if a counter is missing or has decreased",
        outcome=CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        quantity="components of the delay in the emulator",
        columns=("delay_s", "delay_*_s", "delay_packets"),
        source="`medium.txt`",
        against=(),
        tolerance="only the emulator can measure them; the file is rejected if a robot provides it",
        outcome=CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        quantity="distance and speed during the transfer",
        columns=("transfer_distance_*", "transfer_*_speed_m_s"),
        source="`positions.json` if it lists one of the robots, otherwise `track.csv` of the emulator",
        against=(),
        tolerance="the positions are compared only if steps move robots or record positions",
        outcome=CheckOutcome.UNCHECKED,
    ),
)
