"""Contradictions between the results of an iperf3 test and the captures of both ends.

iperf3 counts the bytes that its sockets read and write; a capture contains the packets that passed the interface. At
any time, iperf3 has therefore received at most the bytes that the capture contains until this time. When it has read
its socket buffers, it has received at least the bytes that the kernel has acknowledged (TCP), or the bytes that have
arrived minus the bytes that were dropped at its socket buffer (UDP). Times in the JSON are relative to the start of
the test. The test starts between the client's last message on the control connection and the first data packet.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.model import Protocol
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import NO_TIME, Ints
from fieldkit.measure.captures.headers import TCP
from fieldkit.measure.captures.packets import ACK, NOT_CAPTURED, SYN, Packets
from fieldkit.measure.evidence.host import Counters
from fieldkit.measure.evidence.iperf3 import IperfTest
from fieldkit.measure.transfers.iperf3_load import COOKIE_BYTES, LoadFlow
from fieldkit.measure.transfers.tcp_streams import LONGEST_BYTES

EARLY_NS: Final = 300_000_000
LATE_NS: Final = 500_000_000
"""Tolerances of times: a time in the JSON may be up to `EARLY_NS` earlier or `LATE_NS` later than in the capture,
because iperf3 reads late on a busy robot."""

_BUFFERED_BYTES: Final = 256 << 10
_BUFFERED_WINDOWS: Final = 3
"""Maximum payload in the buffer of a sending socket: `_BUFFERED_BYTES` plus this factor times the bytes in the
capture. Linux expands this buffer to at most 3 congestion windows (tcp_sndbuf_expand). A window is at most the number
of acknowledged bytes, and the initial buffer is 87 kB."""

_BLOCK_BYTES: Final = 128 << 10
"""iperf3's default size of a write over TCP."""
_RACE_DATAGRAMS: Final = 2
_RACE_SHARE: Final = 0.001
"""Tolerance for datagrams that a thread of iperf3 sends while the other streams are counted: a number per stream,
plus a share of all datagrams."""
_RESENT_FACTOR: Final = 2
_RESENT_SEGMENTS: Final = 20
"""Tolerance for retransmissions: the counts may differ by this factor plus this number of segments, because offload
joins segments and the kernel counts handshakes too."""
_TAIL_SHARE: Final = 0.05
_TAIL_DATAGRAMS: Final = 10
"""Tolerance for datagrams that iperf3 sent after the last one that its receiver expected: a share of all datagrams,
plus a number."""


@dataclass(frozen=True)
class LoadEvidence:
    """Captures of a test, and the increments of the kernels' counters during the attempt.

    Attributes:
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        server_port: Server's port of the control connection.
        reverse: True if the server sends.
        sender_counters: Increments of the sender's kernel counters.
        receiver_counters: Increments of the receiver's kernel counters.
    """

    sender: Packets
    receiver: Packets
    server_port: int
    reverse: bool
    sender_counters: Counters
    receiver_counters: Counters


@dataclass(frozen=True, eq=False)
class _Progress:
    """Lower and upper bounds of the number of bytes that the receiver has read from all streams until each time."""

    times_ns: Ints
    lower: Ints
    upper: Ints

    def upper_bound(self, at_ns: int) -> int:
        index = int(np.searchsorted(self.times_ns, at_ns, side="right")) - 1
        return int(self.upper[index]) if index >= 0 else 0

    def lower_bound(self, at_ns: int) -> int:
        index = int(np.searchsorted(self.times_ns, at_ns, side="right")) - 1
        return int(self.lower[index]) if index >= 0 else 0


def find_contradictions(
    flow: LoadFlow, sent: IperfTest, received: IperfTest, evidence: LoadEvidence
) -> Iterator[str]:
    """Yield the contradictions between the JSON of both ends and both captures; none if a packet has no time.

    Args:
        flow: Addresses and ports of the test, which identify its packets.
        sent: JSON of the sender.
        received: JSON of the receiver.
        evidence: Captures and kernel counters of both ends.
    """
    if (evidence.receiver.time_ns == NO_TIME).any() or (evidence.sender.time_ns == NO_TIME).any():
        return
    sent_streams, received_streams = flow.streams(evidence.sender), flow.streams(evidence.receiver)
    if missing := sum(not len(stream) for stream in sent_streams):
        yield f"the sender's capture has no packet of {format_count(missing, 'stream')} of iperf3"
        return
    if flow.protocol is Protocol.UDP:
        yield from _check_datagrams(sent, received, sent_streams, received_streams, evidence)
    else:
        yield from _check_sent_bytes(sent, sent_streams, evidence)
    progress = (
        _udp_progress(flow, received_streams)
        if flow.protocol is Protocol.UDP
        else _tcp_progress(flow, received_streams, evidence)
    )
    if progress is not None:
        yield from _check_arrivals(flow, received, progress, evidence)


def _check_arrivals(
    flow: LoadFlow, received: IperfTest, progress: _Progress, evidence: LoadEvidence
) -> Iterator[str]:
    """Yield a contradiction for the first interval at whose end iperf3 had received too many or too few bytes."""
    total_bytes = sum(interval.payload_bytes for interval in received.intervals)
    if not len(progress.times_ns):
        if total_bytes:
            yield f"iperf3 received {total_bytes} bytes, but the receiver's capture contains no payload of the test"
        return
    first_ns = int(progress.times_ns[0])
    request_ns = _last_request_ns(flow, evidence, first_ns)
    dropped_bytes = 0
    if flow.protocol is Protocol.UDP:
        dropped_bytes = (evidence.receiver_counters.udp_undelivered or 0) * flow.payload_bytes
    received_bytes = 0
    for interval in received.intervals:
        received_bytes += interval.payload_bytes
        if interval.end_s is None:
            continue
        end_ns = round(1e9 * interval.end_s)
        upper = progress.upper_bound(first_ns + end_ns + EARLY_NS)
        lower = progress.lower_bound(request_ns + end_ns - LATE_NS) - dropped_bytes
        if not lower <= received_bytes <= upper:
            bound = f"at least {lower}" if received_bytes < lower else f"at most {upper}"
            iperf3_text = f"iperf3 received {received_bytes} bytes until second {interval.end_s:.1f} of the test"
            yield f"{iperf3_text}, but {bound} according to the receiver's capture"
            return


def _last_request_ns(flow: LoadFlow, evidence: LoadEvidence, first_ns: int) -> int:
    """Return the time of the client's last control message before the data; `first_ns` if there is none."""
    client, server = flow.source_address, flow.destination_address
    if evidence.reverse:
        client, server = server, client
    packets = evidence.receiver
    data_ports = np.array(
        [source_port if not evidence.reverse else destination_port for source_port, destination_port in flow.ports]
    )
    is_request = packets.are_from(client) & packets.are_to(server) & (packets.protocol == TCP)
    is_request &= (
        (packets.dport == evidence.server_port) & (packets.tcp_payload_bytes > 0) & (packets.time_ns < first_ns)
    )
    if flow.protocol is Protocol.TCP:
        is_request &= ~np.isin(packets.sport, data_ports)
    times_ns = packets.time_ns[is_request]
    return int(times_ns.max()) if len(times_ns) else first_ns


def _udp_progress(flow: LoadFlow, streams: list[Packets]) -> _Progress:
    times_ns = np.sort(np.concatenate([stream.time_ns for stream in streams]))
    # A stream contains only the first packet of each datagram.
    upper = flow.payload_bytes * np.arange(1, len(times_ns) + 1)
    # The first fragment of a fragmented datagram does not show that the other fragments arrived.
    fragmented = any(stream.more_fragments.any() for stream in streams)
    return _Progress(times_ns, np.zeros_like(upper) if fragmented else upper, upper)


def _tcp_progress(flow: LoadFlow, streams: list[Packets], evidence: LoadEvidence) -> _Progress | None:
    """Return the progress of all streams.

    None if the SYN of a stream was not captured, or if a stream is so long that its sequence numbers are ambiguous.
    """
    cookie_bytes = 0 if evidence.reverse else COOKIE_BYTES
    parts_ns: list[Ints] = []
    lower: list[Ints] = []
    upper: list[Ints] = []
    for (sport, dport), stream in zip(flow.ports, streams, strict=True):
        first_seq = _first_seq(stream)
        if first_seq is None:
            return None
        data = stream.where(stream.tcp_payload_bytes > 0)
        received = (data.tcp_seq - first_seq) % 2**32 + data.tcp_payload_bytes
        acknowledgments = _acknowledgments(flow, evidence.receiver, sport, dport)
        acknowledged = (acknowledgments.tcp_ack - first_seq) % 2**32
        if max(received.max(initial=0), acknowledged.max(initial=0)) > LONGEST_BYTES:
            return None
        # Captured data raises the upper bound, and acknowledgments raise the lower bound.
        for at_ns, position, increments, other_increments in (
            (data.time_ns, received, upper, lower),
            (acknowledgments.time_ns, acknowledged, lower, upper),
        ):
            total = np.maximum.accumulate(np.maximum(position - cookie_bytes, 0))
            parts_ns.append(at_ns)
            increments.append(np.diff(total, prepend=0))
            other_increments.append(np.zeros_like(total))
    times_ns = np.concatenate(parts_ns)
    order = np.argsort(times_ns, kind="stable")
    bounds = [np.cumsum(np.concatenate(parts)[order]) for parts in (lower, upper)]
    # Entries before the first payload, such as those of the cookie, are omitted.
    first = int(np.argmax(bounds[1] > 0)) if len(times_ns) and bounds[1][-1] > 0 else len(times_ns)
    return _Progress(times_ns[order][first:], bounds[0][first:], bounds[1][first:])


def _first_seq(stream: Packets) -> int | None:
    """Return the sequence number of the first byte of a stream, or None if its SYN was not captured."""
    syn = stream.where(stream.tcp_flags & SYN != 0)
    return int(syn.tcp_seq[0]) + 1 if len(syn) else None


def _acknowledgments(flow: LoadFlow, packets: Packets, sport: int, dport: int) -> Packets:
    """Return the packets that acknowledge data of a stream."""
    ends = packets.are_from(flow.destination_address) & packets.are_to(flow.source_address)
    return packets.where(
        ends
        & (packets.protocol == TCP)
        & (packets.sport == dport)
        & (packets.dport == sport)
        & (packets.tcp_flags & ACK != 0)
        & (packets.tcp_flags & SYN == 0)
    )


def _check_sent_bytes(sent: IperfTest, streams: list[Packets], evidence: LoadEvidence) -> Iterator[str]:
    """Yield a contradiction for each count of a TCP sender that disagrees with its capture: bytes, retransmissions.

    iperf3 must have written at least the captured bytes, and at most as many more as its sockets can buffer. Nothing
    is checked if the SYN of a stream was not captured, or if a stream is too long for 32-bit sequence numbers.
    """
    written_bytes = sum(interval.payload_bytes for interval in sent.intervals)
    cookie_bytes = 0 if evidence.reverse else COOKIE_BYTES
    unique_bytes, carried_bytes, segment_bytes = 0, 0, 1
    for stream in streams:
        first_seq = _first_seq(stream)
        if first_seq is None:
            return
        data = stream.where(stream.tcp_payload_bytes > 0)
        end = int(((data.tcp_seq - first_seq) % 2**32 + data.tcp_payload_bytes).max(initial=0))
        if end > LONGEST_BYTES:
            return
        unique_bytes += max(end - cookie_bytes, 0)
        carried_bytes += int(data.tcp_payload_bytes.sum()) - cookie_bytes
        mss = [int(packets.tcp_mss.max(initial=0)) for packets in (evidence.sender, stream)]
        segment_bytes = max(segment_bytes, *mss)
    # From version 3.16 on, each stream has a thread, which may continue to write while the other streams are counted.
    if written_bytes + _BLOCK_BYTES * len(streams) < unique_bytes:
        yield f"iperf3 sent {written_bytes} bytes, but {unique_bytes} are in the sender's capture"
    elif written_bytes > (1 + _BUFFERED_WINDOWS) * unique_bytes + _BUFFERED_BYTES * len(streams):
        yield f"iperf3 sent {written_bytes} bytes, but only {unique_bytes} are in the sender's capture"
    retransmits = [interval.retransmits for interval in sent.intervals if interval.retransmits is not None]
    captured_segments, reported = max(carried_bytes - unique_bytes, 0) / segment_bytes, sum(retransmits)
    differs = (
        _RESENT_FACTOR * captured_segments + _RESENT_SEGMENTS < reported,
        _RESENT_FACTOR * reported + _RESENT_SEGMENTS < captured_segments,
    )
    if len(retransmits) == len(sent.intervals) and any(differs):
        capture_text = f"about {captured_segments:.0f} according to the sender's capture"
        yield f"iperf3 retransmitted {reported} segments, but {capture_text}"


def _check_datagrams(
    sent: IperfTest,
    received: IperfTest,
    sent_streams: list[Packets],
    received_streams: list[Packets],
    evidence: LoadEvidence,
) -> Iterator[str]:
    """Yield the contradictions between the datagrams that iperf3 counted at both ends and those in the captures.

    There are none if a count is missing in the JSON.
    """
    counts = [
        [getattr(interval, name) for interval in test.intervals]
        for test, name in ((sent, "datagrams"), (received, "datagrams"), (received, "lost"))
    ]
    if any(None in part or not part for part in counts):
        return
    sent_count, expected, lost = map(sum, counts)
    captured, arrived = sum(map(len, sent_streams)), sum(map(_distinct_datagrams, received_streams))
    # From version 3.16 on, each stream has a thread, which may continue to send while the other streams are counted.
    race_tolerance = _RACE_DATAGRAMS * len(sent_streams) + round(_RACE_SHARE * sent_count)
    if sent_count + race_tolerance < captured:
        yield f"iperf3 sent {sent_count} datagrams, but {captured} are in the sender's capture"
    refused = evidence.sender_counters.udp_send_errors or 0
    # `tail` is the number of datagrams that were sent after the last one that iperf3's receiver expected. `missed` is
    # the number of datagrams that only the sender's capture contains.
    tail, missed = max(sent_count - expected, 0), max(captured - arrived, 0)
    # iperf3 may count datagrams that are not in the sender's capture: those that the socket refused, and those that
    # the queue dropped before the capture. The receiver counts the dropped ones as expected, because their sequence
    # numbers are missing, so the tail is short.
    is_plausible = captured + refused >= sent_count or tail <= missed + _TAIL_SHARE * sent_count + _TAIL_DATAGRAMS
    if not is_plausible:
        capture_text = f"the sender's capture contains {captured}"
        yield f"iperf3 sent {sent_count} datagrams, but the receiver expected {expected}, and {capture_text}"
    undelivered = evidence.receiver_counters.udp_undelivered or 0
    max_lost = missed + undelivered + max(sent_count - captured, 0)
    if not any(stream.more_fragments.any() for stream in received_streams):
        # Each copy reduces the number of losses that iperf3 reports by one.
        copies = sum(map(len, received_streams)) - arrived
        if not missed - tail - copies - race_tolerance <= lost <= max_lost + race_tolerance:
            missing_text = f"the receiver's capture lacks {format_count(missed, 'datagram')} of the sender's capture"
            lost_text = f"iperf3 lost {format_count(lost, 'datagram')}"
            yield f"{lost_text}, but {missing_text}, and the receiver's kernel dropped {undelivered}"


def _distinct_datagrams(stream: Packets) -> int:
    """Return the number of datagrams without duplicates, or with them if the content of a datagram was not captured.

    Each datagram of iperf3 starts with a unique number and time, so only duplicates have equal content.
    """
    if (stream.content == NOT_CAPTURED).any():
        return len(stream)
    return len(np.unique(stream.content))
