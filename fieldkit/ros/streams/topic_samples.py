"""Samples of topics, from logs that fieldkit's agent writes on a robot, and from captures, by the heads of samples.

A log (`fieldkit.agent.messaging.records`) is a magic number followed by fixed-size records. If the writer of a log
was killed, the log ends with zeros, because the file grows by blocks.

The agent starts each sample with the empty layout of `std_msgs/UInt8MultiArray` and the length of its data, followed
by the head (`fieldkit.agent.messaging.stream`): magic number, sequence number and time of sending. The head is in a
capture if the snap length of the capture includes that part of the packet. This is always true for the first sample
of a packet, but TCP or a middleware may add more samples to the same packet. An image has the same head in its first
pixels.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from mmap import mmap
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import LITTLE, Buffer, Frames, Integers, Ints, Mask, Table
from fieldkit.measure.captures.headers import TCP, ip_header_positions, ip_headers
from fieldkit.measure.captures.packets import ACK, UDP_HEADER_BYTES, Packets
from fieldkit.measure.captures.pcap import CHUNK_BYTES, frame_reader
from fieldkit.measure.evidence import reading
from fieldkit.measure.transfers.udp import with_ports

LOG_MAGIC: Final = b"fieldkit topic 1"

_RECORD: Final = np.dtype(
    [("kind", "<u2"), ("none", "<u2"), ("size", "<u4"), ("sequence", "<i8"), ("sent_ns", "<i8"), ("at_ns", "<i8")]
)
RECORD_BYTES: Final = _RECORD.itemsize

_KINDS: Final = range(1, 11)
_SAMPLE, DISCOVERY_STARTED, MATCHED, REFUSED, SKIPPED, FOREIGN, _END, _WRITER, READ, UNREADABLE = _KINDS
"""Kinds of records: see the constants of the same names in `fieldkit.agent.messaging.records`. `MATCHED` is the
discovery of the other end, `FOREIGN` a message of another program, and `_WRITER` the role and topic of the writer."""
PUBLISHER: Final = 1
SUBSCRIBER: Final = 2
_HAS_CHECKSUM: Final = 1
"""Value of `sent_ns` in an end record whose size field is a checksum. Older logs, without writer records, have
none."""
_SIZE_OFFSET: Final = 4
"""Offset of the size field in a record."""


@dataclass(frozen=True, eq=False)
class TopicSamples(Table):
    """Samples in the order of the log; times by the clocks of two robots.

    Attributes:
        sequence: Sequence number, from 0.
        size_bytes: Serialized size.
        sent_ns: Time of sending by the sender's clock, stored in the sample, nanoseconds since 1970 UTC.
        at_ns: Time at which the middleware accepted the sample, or at which it arrived, by the clock of the robot.
    """

    sequence: Ints
    size_bytes: Ints
    sent_ns: Ints
    at_ns: Ints


@dataclass(frozen=True, eq=False)
class SampleReads(Table):
    """Reads of the newest sample by the subscriber's program, in order.

    Attributes:
        sequence: Number of the newest sample that had arrived; -1 if none had.
        sent_ns: Its time of sending by the sender's clock, nanoseconds since 1970 UTC.
        at_ns: Time of the read by the subscriber's clock.
    """

    sequence: Ints
    sent_ns: Ints
    at_ns: Ints


def no_reads() -> SampleReads:
    """Return an empty table."""
    return SampleReads(*(np.empty(0, dtype=np.int64) for _ in range(3)))


@dataclass(frozen=True)
class TopicLog:
    """Log of one end of a topic.

    Attributes:
        samples: Samples that the middleware accepted, or that arrived.
        discovery_start_ns: Time at which the middleware started discovery; None if it is not recorded.
        matched_ns: Time at which the other end was discovered; None if it was not discovered.
        refused: Number of samples that the middleware did not accept.
        skipped: Number of samples that were not sent, because writing an earlier one took too long.
        foreign: Number of received messages that are not samples of the stream.
        is_complete: True if the log has its end record.
        kinds: Number of records of each kind.
        times_ns: Time of every record in the order of the log, by the writer's clock.
        numbers: Sequence number of each sample that was passed to the middleware or arrived, including refused ones.
        role: `PUBLISHER` or `SUBSCRIBER`; None in a log without a writer record (older versions).
        topic_sum: CRC-32 of the topic's name; None in a log without a writer record (older versions).
        reads: Reads of the newest sample by the subscriber's program.
        unreadable: Number of received camera frames whose pixels do not contain a valid number and time.
    """

    samples: TopicSamples
    discovery_start_ns: int | None
    matched_ns: int | None
    refused: int
    skipped: int
    foreign: int
    is_complete: bool
    kinds: Mapping[int, int] = field(default_factory=dict)
    times_ns: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    numbers: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    role: int | None = None
    topic_sum: int | None = None
    reads: SampleReads = field(default_factory=no_reads)
    unreadable: int = 0


def read_log(path: Path) -> TopicLog:
    """Read a log. A record that is truncated or has no time is ignored.

    Raises:
        EvidenceError: The file is missing or not such a log, it has a record of an unknown kind, the number of
            samples in its end record is wrong, or its checksum is wrong.
    """
    content = reading.mapped(path)
    if content[: len(LOG_MAGIC)] != LOG_MAGIC:
        raise EvidenceError("is not a log of a topic", where=str(path), remedy="repeat the measurement")
    count = (len(content) - len(LOG_MAGIC)) // RECORD_BYTES
    records = np.frombuffer(content, _RECORD, count, offset=len(LOG_MAGIC))
    records = records[records["at_ns"] != 0]
    if len(unknown := np.setdiff1d(records["kind"], _KINDS)):
        reason = f"has a record of kind {unknown[0]}, which no agent writes"
        raise EvidenceError(reason, where=str(path), remedy="repeat the measurement")

    by_kind = {kind: records[records["kind"] == kind] for kind in _KINDS}
    samples, ends = by_kind[_SAMPLE], by_kind[_END]
    if len(ends) and (len(ends) > 1 or records["kind"][-1] != _END or ends["sequence"][0] != len(samples)):
        raise EvidenceError(
            "does not have the number of samples in its end record", where=str(path), remedy="repeat the measurement"
        )
    start_records, match_records, writer_records = by_kind[DISCOVERY_STARTED], by_kind[MATCHED], by_kind[_WRITER]
    if len(ends) and not _is_intact(content, ends[0], required=len(writer_records) > 0):
        raise EvidenceError("was changed: its checksum is wrong", where=str(path), remedy="repeat the measurement")
    offered_records = records[(records["kind"] == _SAMPLE) | (records["kind"] == REFUSED)]
    return TopicLog(
        samples=TopicSamples(*(samples[name].astype(np.int64) for name in ("sequence", "size", "sent_ns", "at_ns"))),
        discovery_start_ns=int(start_records["at_ns"][0]) if len(start_records) else None,
        matched_ns=int(match_records["at_ns"][0]) if len(match_records) else None,
        refused=len(by_kind[REFUSED]),
        skipped=int(by_kind[SKIPPED]["sequence"].sum()),
        foreign=len(by_kind[FOREIGN]),
        is_complete=bool(len(ends)),
        kinds={kind: len(records_of_kind) for kind, records_of_kind in by_kind.items()},
        times_ns=records["at_ns"].astype(np.int64),
        numbers=offered_records["sequence"].astype(np.int64),
        role=int(writer_records["sequence"][0]) if len(writer_records) else None,
        topic_sum=int(writer_records["size"][0]) if len(writer_records) else None,
        reads=SampleReads(*(by_kind[READ][name].astype(np.int64) for name in ("sequence", "sent_ns", "at_ns"))),
        unreadable=len(by_kind[UNREADABLE]),
    )


def _is_intact(content: bytes | mmap, end_record: np.void, *, required: bool) -> bool:
    """Return True if the checksum in the end record is correct, or missing and not required."""
    if end_record["sent_ns"] != _HAS_CHECKSUM:
        return not required
    record = end_record.tobytes()
    starts_at = content.rfind(record)
    without_checksum = record[:_SIZE_OFFSET] + bytes(4) + record[_SIZE_OFFSET + 4 :]
    return zlib.crc32(without_checksum, zlib.crc32(memoryview(content)[:starts_at])) == int(end_record["size"])


_WORD_BYTES: Final = 8
"""Size of an integer in the head of a sample."""


@dataclass(frozen=True, eq=False)
class Occurrences(Table):
    """Occurrences of a pattern in the order of the capture.

    Attributes:
        packet: Index of the packet in the result of `pcap.read`.
        offset: Position of the pattern in the packet's IP payload, in bytes.
        first: Little-endian integer in the 8 bytes after the pattern.
        second: Integer in the next 8 bytes.
    """

    packet: Ints
    offset: Ints
    first: Ints
    second: Ints


def find_bytes(path: Path, pattern: bytes) -> Occurrences:
    """Return each captured occurrence of a pattern with the two integers after it.

    Occurrences that start in a later IP fragment, or that the snap length truncated, are not found.

    Raises:
        EvidenceError: For the same reasons as `pcap.read`.
    """
    data = reading.mapped(path)
    integers = Integers(data)
    reader = frame_reader(data)
    parts, packet_count = [_no_occurrences()], 0
    for chunk in reader(data, where=str(path), chunk_bytes=CHUNK_BYTES) if reader else ():
        ip = ip_headers(integers, chunk.frames, ip_header_positions(integers, chunk.frames))
        frames = chunk.frames.where(ip.frame)
        matches = _positions(data, frames, pattern)
        row = np.searchsorted(frames.start, matches, side="right") - 1
        ends = frames.start[row] + frames.captured_bytes[row]
        is_inside = (matches >= ip.payload_at[row]) & (matches + len(pattern) + 2 * _WORD_BYTES <= ends)
        is_inside &= ip.fragment_offset[row] == 0
        matches, row = matches[is_inside], row[is_inside]
        little, after = integers.with_order(LITTLE), matches + len(pattern)
        numbers = (little.u64(after + at).astype(np.int64) for at in (0, _WORD_BYTES))
        parts.append(Occurrences(packet_count + row, matches - ip.payload_at[row], *numbers))
        packet_count += len(frames)
    return Occurrences.concatenated(parts)


def _no_occurrences() -> Occurrences:
    return Occurrences(*(np.empty(0, dtype=np.int64) for _ in range(4)))


def _positions(data: Buffer, frames: Frames, pattern: bytes) -> Ints:
    """Return the positions of the pattern in the file, between the first frame and the end of the last."""
    positions: list[int] = []
    if len(frames):
        at, end = int(frames.start[0]), int(frames.start[-1] + frames.captured_bytes[-1])
        while (at := data.find(pattern, at, end)) >= 0:
            positions.append(at)
            at += 1
    return np.array(positions, dtype=np.int64)


MAGIC: Final = b"fieldkit"
HEAD_BYTES: Final = 24
"""Size of the head of a sample: magic number, sequence number and time of sending."""


@dataclass(frozen=True, eq=False)
class SampleHeads(Table):
    """Heads of samples in the order of a capture, including heads of retransmitted samples.

    Attributes:
        sequence: Sequence number of the sample.
        sent_ns: Time of sending stored in the sample, by the publisher's clock.
        at_ns: Time of capture of the packet.
        is_complete: True if the packet contains the whole sample.
        end: TCP sequence number after the sample, modulo 2**32; 0 for UDP.
        sport: Source port of the packet.
        dport: Destination port of the packet.
    """

    sequence: Ints
    sent_ns: Ints
    at_ns: Ints
    is_complete: Mask
    end: Ints
    sport: Ints
    dport: Ints

    def first(self) -> "SampleHeads":
        """Return the first head of each sample, in the order of sequence numbers."""
        _, index = np.unique(self.sequence, return_index=True)
        return self.where(index)


@dataclass(frozen=True, eq=False)
class SampleFlow:
    """Packets of a topic in one capture.

    Attributes:
        heads: Samples from publisher to subscriber whose head was captured.
        packets: All packets of the topic's data from publisher to subscriber; fragments have the ports of the first.
        reverse: All packets of the topic's data from subscriber to publisher; ports as in `packets`.
    """

    heads: SampleHeads
    packets: Packets
    reverse: Packets

    @property
    def is_tcp(self) -> bool:
        """True if the data are sent over TCP."""
        return bool((self.packets.protocol == TCP).any())

    def connection(self) -> tuple[Packets, Packets] | None:
        """Return the packets with payload of the TCP connection of the samples, and the acknowledgements.

        None if the samples are in several connections, or in none.
        """
        ports = np.unique(np.column_stack((self.heads.sport, self.heads.dport)), axis=0)
        if len(ports) != 1:
            return None
        ((sport, dport),) = ports.tolist()
        packets, reverse = self.packets, self.reverse
        data = packets.where((packets.sport == sport) & (packets.dport == dport) & (packets.tcp_payload_bytes > 0))
        return data, reverse.where(
            (reverse.sport == dport) & (reverse.dport == sport) & (reverse.tcp_flags & ACK != 0)
        )


def find_heads(path: Path, size_bytes: int, width: int = 0) -> Occurrences:
    """Return the heads of samples in a capture. Raises the same errors as `find_bytes`.

    Args:
        path: The capture.
        size_bytes: Data bytes of a sample.
        width: Pixels per row of images; 0 if the samples are not images.
    """
    return find_bytes(path, _before_head(size_bytes, width) + MAGIC)


def _before_head(size_bytes: int, width: int) -> bytes:
    """Return the last fields of a message before its data.

    For an array these are an empty layout and the size of the data, for an image the bytes per row and this size.
    """
    return struct.pack("<II", width, size_bytes) if width else struct.pack("<III", 0, 0, size_bytes)


def sample_flow(
    packets: Packets,
    occurrences: Occurrences,
    ports: frozenset[int],
    size_bytes: int,
    is_forward: Callable[[Packets], Mask],
    *,
    width: int = 0,
) -> SampleFlow:
    """Return the packets of a topic in a capture.

    Args:
        packets: Packets of the capture.
        occurrences: Result of `find_heads` for the same capture.
        ports: Ports of the topic's data.
        size_bytes: Data bytes of a sample.
        is_forward: Returns a mask of the packets from publisher to subscriber.
        width: Pixels per row of images; 0 if the samples are not images.
    """
    packets_with_ports = with_ports(packets)
    data = np.isin(packets_with_ports.dport, list(ports)) | np.isin(packets_with_ports.sport, list(ports))
    forward = data & is_forward(packets)
    occurrences = occurrences.where(forward[occurrences.packet])
    carrier = packets.where(occurrences.packet)
    tcp_header_bytes = carrier.ip_payload_bytes - carrier.tcp_payload_bytes
    is_tcp = carrier.protocol == TCP
    before_bytes = len(_before_head(size_bytes, width))
    starts = occurrences.offset + before_bytes - np.where(is_tcp, tcp_header_bytes, UDP_HEADER_BYTES)
    ends = starts + size_bytes
    heads = SampleHeads(
        sequence=occurrences.first,
        sent_ns=occurrences.second,
        at_ns=carrier.time_ns,
        is_complete=np.where(is_tcp, carrier.tcp_payload_bytes, carrier.ip_payload_bytes - UDP_HEADER_BYTES) >= ends,
        end=np.where(is_tcp, (carrier.tcp_seq + ends) % (1 << 32), 0),
        sport=carrier.sport,
        dport=carrier.dport,
    )
    return SampleFlow(heads, packets_with_ports.where(forward), packets_with_ports.where(data & ~is_forward(packets)))
