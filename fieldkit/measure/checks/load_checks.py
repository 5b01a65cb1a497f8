"""Contradictions between the results of an iperf3 test and the captures of both ends.

iperf3 counts what its sockets read and write, a capture what passed the interface. So the bytes that iperf3 has
received by a moment are at most those in the capture by then. They are at least those that the kernel had
acknowledged (TCP), or those that arrived less those that its socket buffer refused (UDP). Moments of the JSON count
from the start of the test: between the client's last message on the control connection and the first packet of data.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.model import Protocol
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import NO_TIME, Ints
from fieldkit.measure.captures.ip import TCP
from fieldkit.measure.captures.packets import ACK, NOT_KEPT, SYN, Packets
from fieldkit.measure.evidence.host import Counters
from fieldkit.measure.evidence.iperf3 import IperfTest
from fieldkit.measure.transfers.load import LoadFlow
from fieldkit.measure.transfers.streams import LONGEST_BYTES

COOKIE_BYTES: Final = 37
"""With which the client begins each TCP connection (iperf_api.h, COOKIE_SIZE)."""

EARLY_NS: Final = 300_000_000
LATE_NS: Final = 500_000_000
"""Difference between a moment of the JSON and of the capture: a busy robot reads late."""

_BUFFERED_BYTES: Final = 256 << 10
_BUFFERED_TIMES: Final = 3
"""Payload that a sending socket buffers: Linux lets it grow to 3 congestion windows at most (tcp_sndbuf_expand), a
window to what was acknowledged so far, and begins with 87 kB."""

_BLOCK_BYTES: Final = 128 << 10
_RACE_DATAGRAMS: Final = 2
_RACE_SHARE: Final = 0.001
_RESENT_TIMES: Final = 2
_RESENT_SEGMENTS: Final = 20
_TAIL_SHARE: Final = 0.05
_TAIL_DATAGRAMS: Final = 10


@dataclass(frozen=True)
class LoadWitness:
    """Captures of a test, and what the kernels refused during the attempt.

    Attributes:
        sender: Packets of the capture at the sender.
        receiver: Packets of the capture at the receiver.
        server_port: Port of the control connection at the server.
        reverse: Whether the server sends.
        sender_counters: How the counters of the sender's kernel moved.
        receiver_counters: How those of the receiver's moved.
    """

    sender: Packets
    receiver: Packets
    server_port: int
    reverse: bool
    sender_counters: Counters
    receiver_counters: Counters


@dataclass(frozen=True, eq=False)
class _Progress:
    """Bytes that have come by each moment, of all streams; the receiver has read from `least` to `most` of them."""

    times_ns: Ints
    least: Ints
    most: Ints

    def most_by(self, at_ns: int) -> int:
        index = int(np.searchsorted(self.times_ns, at_ns, side="right")) - 1
        return int(self.most[index]) if index >= 0 else 0

    def least_by(self, at_ns: int) -> int:
        index = int(np.searchsorted(self.times_ns, at_ns, side="right")) - 1
        return int(self.least[index]) if index >= 0 else 0


def find(flow: LoadFlow, sent: IperfTest, received: IperfTest, witness: LoadWitness) -> Iterator[str]:
    """Yield the contradictions between both ends' JSON and both captures; captures without times have none."""
    if (witness.receiver.time_ns == NO_TIME).any() or (witness.sender.time_ns == NO_TIME).any():
        return
    left, came = flow.streams(witness.sender), flow.streams(witness.receiver)
    if missing := sum(not len(stream) for stream in left):
        yield f"{format_count(missing, 'stream')} of iperf3 left no packet in the sender's capture"
        return
    if flow.protocol is Protocol.UDP:
        yield from _datagrams(sent, received, left, came, witness)
    else:
        yield from _sent_bytes(sent, left, witness)
    progress = _udp_progress(flow, came) if flow.protocol is Protocol.UDP else _tcp_progress(flow, came, witness)
    if progress is not None:
        yield from _arrivals(flow, received, progress, witness)


def _arrivals(flow: LoadFlow, received: IperfTest, progress: _Progress, witness: LoadWitness) -> Iterator[str]:
    """Yield the first interval by whose end iperf3 had received more, or less, than the capture allows."""
    total_bytes = sum(interval.payload_bytes for interval in received.intervals)
    if not len(progress.times_ns):
        if total_bytes:
            yield f"iperf3 received {total_bytes} bytes, and the receiver's capture holds none of them"
        return
    first_ns = int(progress.times_ns[0])
    earliest_ns = _last_order_ns(flow, witness, first_ns)
    refused_bytes = 0
    if flow.protocol is Protocol.UDP:
        refused_bytes = (witness.receiver_counters.udp_undelivered or 0) * flow.payload_bytes
    by_now = 0
    for interval in received.intervals:
        by_now += interval.payload_bytes
        if interval.end_s is None:
            continue
        end_ns = round(1e9 * interval.end_s)
        most = progress.most_by(first_ns + end_ns + EARLY_NS)
        least = progress.least_by(earliest_ns + end_ns - LATE_NS) - refused_bytes
        if not least <= by_now <= most:
            held = f"at least {least}" if by_now < least else f"at most {most}"
            when = f"by second {interval.end_s:.1f} of the test"
            yield f"iperf3 received {by_now} bytes {when}, and the receiver's capture holds {held}"
            return


def _last_order_ns(flow: LoadFlow, witness: LoadWitness, first_ns: int) -> int:
    """Return when the client last said something on the control connection before data came; `first_ns` if never."""
    client, server = flow.source_address, flow.destination_address
    if witness.reverse:
        client, server = server, client
    packets = witness.receiver
    data_ports = np.array([ours if not witness.reverse else theirs for ours, theirs in flow.ports])
    said = packets.are_from(client) & packets.are_to(server) & (packets.protocol == TCP)
    said &= (packets.dport == witness.server_port) & (packets.tcp_payload_bytes > 0) & (packets.time_ns < first_ns)
    if flow.protocol is Protocol.TCP:
        said &= ~np.isin(packets.sport, data_ports)
    times_ns = packets.time_ns[said]
    return int(times_ns.max()) if len(times_ns) else first_ns


def _udp_progress(flow: LoadFlow, came: list[Packets]) -> _Progress:
    times_ns = np.sort(np.concatenate([stream.time_ns for stream in came]))
    most = flow.payload_bytes * np.arange(1, len(times_ns) + 1)
    # Of a fragmented datagram the first fragment alone shows nothing of the rest.
    fragmented = any(stream.more_fragments.any() for stream in came)
    return _Progress(times_ns, np.zeros_like(most) if fragmented else most, most)


def _tcp_progress(flow: LoadFlow, came: list[Packets], witness: LoadWitness) -> _Progress | None:
    """Return the progress of all streams; None if a stream is too long for its sequence numbers."""
    cookie_bytes = 0 if witness.reverse else COOKIE_BYTES
    times: list[Ints] = []
    least: list[Ints] = []
    most: list[Ints] = []
    for (sport, dport), stream in zip(flow.ports, came, strict=True):
        begin = _begin(stream)
        if begin is None:
            return None
        data = stream.where(stream.tcp_payload_bytes > 0)
        reached = (data.tcp_seq - begin) % 2**32 + data.tcp_payload_bytes
        answers = _answers(flow, witness.receiver, sport, dport)
        acked = (answers.tcp_ack - begin) % 2**32
        if max(reached.max(initial=0), acked.max(initial=0)) > LONGEST_BYTES:
            return None
        for at_ns, bytes_by_then, growth, other in (
            (data.time_ns, reached, most, least),
            (answers.time_ns, acked, least, most),
        ):
            by_then = np.maximum.accumulate(np.maximum(bytes_by_then - cookie_bytes, 0))
            times.append(at_ns)
            growth.append(np.diff(by_then, prepend=0))
            other.append(np.zeros_like(by_then))
    moments = np.concatenate(times)
    order = np.argsort(moments, kind="stable")
    grown = [np.cumsum(np.concatenate(parts)[order]) for parts in (least, most)]
    first = int(np.argmax(grown[1] > 0)) if len(moments) and grown[1][-1] > 0 else len(moments)
    return _Progress(moments[order][first:], grown[0][first:], grown[1][first:])


def _begin(stream: Packets) -> int | None:
    """Return the sequence number of the first byte of a stream, None if its SYN was not captured."""
    syn = stream.where(stream.tcp_flags & SYN != 0)
    return int(syn.tcp_seq[0]) + 1 if len(syn) else None


def _answers(flow: LoadFlow, packets: Packets, sport: int, dport: int) -> Packets:
    ends = packets.are_from(flow.destination_address) & packets.are_to(flow.source_address)
    return packets.where(
        ends
        & (packets.protocol == TCP)
        & (packets.sport == dport)
        & (packets.dport == sport)
        & (packets.tcp_flags & ACK != 0)
        & (packets.tcp_flags & SYN == 0)
    )


def _sent_bytes(sent: IperfTest, left: list[Packets], witness: LoadWitness) -> Iterator[str]:
    """Yield whether a TCP sender wrote less than left it, or more than its socket can hold beside that."""
    written = sum(interval.payload_bytes for interval in sent.intervals)
    cookie_bytes = 0 if witness.reverse else COOKIE_BYTES
    unique, carried, segment_bytes = 0, 0, 1
    for stream in left:
        begin = _begin(stream)
        if begin is None:
            return
        data = stream.where(stream.tcp_payload_bytes > 0)
        reached = int(((data.tcp_seq - begin) % 2**32 + data.tcp_payload_bytes).max(initial=0))
        if reached > LONGEST_BYTES:
            return
        unique += max(reached - cookie_bytes, 0)
        carried += int(data.tcp_payload_bytes.sum()) - cookie_bytes
        mss = [int(packets.tcp_mss.max(initial=0)) for packets in (witness.sender, stream)]
        segment_bytes = max(segment_bytes, *mss)
    # From 3.16 on a thread of each stream may write on while the others are counted.
    if written + _BLOCK_BYTES * len(left) < unique:
        yield f"iperf3 sent {written} bytes, and {unique} are in the sender's capture"
    elif written > (1 + _BUFFERED_TIMES) * unique + _BUFFERED_BYTES * len(left):
        yield f"iperf3 sent {written} bytes, and only {unique} are in the sender's capture"
    again = [interval.retransmits for interval in sent.intervals if interval.retransmits is not None]
    seen, told = max(carried - unique, 0) / segment_bytes, sum(again)
    apart = (_RESENT_TIMES * seen + _RESENT_SEGMENTS < told, _RESENT_TIMES * told + _RESENT_SEGMENTS < seen)
    if len(again) == len(sent.intervals) and any(apart):
        yield f"iperf3 has {told} segments sent again, and the sender's capture about {seen:.0f}"


def _datagrams(
    sent: IperfTest, received: IperfTest, left: list[Packets], came: list[Packets], witness: LoadWitness
) -> Iterator[str]:
    counts = [
        [getattr(interval, name) for interval in test.intervals]
        for test, name in ((sent, "datagrams"), (received, "datagrams"), (received, "lost"))
    ]
    if any(None in part or not part for part in counts):
        return
    wrote, expected, lost = map(sum, counts)
    seen, arrived = sum(map(len, left)), sum(map(_distinct, came))
    # From 3.16 on a thread of each stream may go on while the others are counted.
    race = _RACE_DATAGRAMS * len(left) + round(_RACE_SHARE * wrote)
    if wrote + race < seen:
        yield f"iperf3 sent {wrote} datagrams, and {seen} are in the sender's capture"
    refused = witness.sender_counters.udp_send_errors or 0
    tail, missed = max(wrote - expected, 0), max(seen - arrived, 0)
    # A queue of the sender that drops datagrams before the capture leaves gaps in the numbers that the receiver sees.
    near = seen + refused >= wrote or tail <= missed + _TAIL_SHARE * wrote + _TAIL_DATAGRAMS
    if not near:
        yield f"iperf3 sent {wrote} datagrams, of which the receiver expected {expected}, and {seen} were captured"
    undelivered = witness.receiver_counters.udp_undelivered or 0
    most = missed + undelivered + max(wrote - seen, 0)
    if not any(stream.more_fragments.any() for stream in came):
        # A copy takes one off the losses.
        copies = sum(map(len, came)) - arrived
        if not missed - tail - copies - race <= lost <= most + race:
            lack = f"the receiver's capture lacks {missed} of those in the sender's"
            yield f"iperf3 lost {lost} datagrams, {lack}, and its kernel refused {undelivered}"


def _distinct(stream: Packets) -> int:
    """Return the number of datagrams without duplicates: each has its own number and time at its beginning."""
    if (stream.content == NOT_KEPT).any():
        return len(stream)
    return len(np.unique(stream.content))
