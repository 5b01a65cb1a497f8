"""Logs of topics written by the agent on a robot (`fieldkit.agent.records`): fixed-size records after a magic.

A log whose writer was killed ends with zeros, because the file grows by blocks.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from mmap import mmap
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Ints, Table
from fieldkit.measure.evidence import reading

MAGIC: Final = b"fieldkit topic 1"

_RECORD: Final = np.dtype(
    [("kind", "<u2"), ("none", "<u2"), ("size", "<u4"), ("sequence", "<i8"), ("sent_ns", "<i8"), ("at_ns", "<i8")]
)
RECORD_BYTES: Final = _RECORD.itemsize

_KINDS: Final = range(1, 9)
_SAMPLE, BEGUN, MATCHED, REFUSED, SKIPPED, FOREIGN, _END, _ORIGIN = _KINDS
PUBLISHER: Final = 1
SUBSCRIBER: Final = 2
_HAS_CHECKSUM: Final = 1
"""Value in an end record whose size field is a checksum; logs of versions without origin records have no checksum."""
_SIZE_AT: Final = 4


@dataclass(frozen=True, eq=False)
class TopicSamples(Table):
    """Samples in the order of the log; times by the clocks of two robots.

    Attributes:
        sequence: Sequence number, from 0.
        size_bytes: Serialized size.
        sent_ns: Time of sending by the sender's clock, stored in the sample, nanoseconds since 1970 UTC.
        at_ns: Time at which the middleware accepted it, or at which it arrived, by the clock of the log's robot.
    """

    sequence: Ints
    size_bytes: Ints
    sent_ns: Ints
    at_ns: Ints


@dataclass(frozen=True)
class TopicLog:
    """Log of one end of a topic.

    Attributes:
        samples: Samples that the middleware accepted, or that arrived.
        begun_ns: Time at which the middleware started discovery; None if it is not recorded.
        matched_ns: Time at which the other end was discovered; None if it never was.
        refused: Number of samples that the middleware did not accept.
        skipped: Number of samples whose time passed while an earlier one was being written.
        foreign: Number of received messages that are not samples of the stream.
        whole: True if the log has its end record.
        kinds: Number of records of each kind.
        times_ns: Time of every record in the order of the log, by the writer's clock.
        numbers: Sequence number of each sample that was passed to the middleware or arrived, including refused ones.
        end: `PUBLISHER` or `SUBSCRIBER`; None in a log of a version without origin records.
        topic_sum: CRC-32 of the topic's name; None in a log of a version without origin records.
    """

    samples: TopicSamples
    begun_ns: int | None
    matched_ns: int | None
    refused: int
    skipped: int
    foreign: int
    whole: bool
    kinds: Mapping[int, int] = field(default_factory=dict)
    times_ns: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    numbers: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    end: int | None = None
    topic_sum: int | None = None


def read(path: Path) -> TopicLog:
    """Read a log. A record that is truncated or has no time is ignored.

    Raises:
        EvidenceError: The file is missing or not such a log, the number of samples in its end record is wrong, or it
            was changed after the end record was written.
    """
    content = reading.mapped(path)
    if content[: len(MAGIC)] != MAGIC:
        raise EvidenceError("is not a log of a topic", where=str(path), remedy="repeat the measurement")
    count = (len(content) - len(MAGIC)) // RECORD_BYTES
    records = np.frombuffer(content, _RECORD, count, offset=len(MAGIC))
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
    started, matched, origin = by_kind[BEGUN], by_kind[MATCHED], by_kind[_ORIGIN]
    if len(ends) and not _is_intact(content, ends[0], required=len(origin) > 0):
        raise EvidenceError("was changed: its checksum is wrong", where=str(path), remedy="repeat the measurement")
    offered = records[(records["kind"] == _SAMPLE) | (records["kind"] == REFUSED)]
    return TopicLog(
        samples=TopicSamples(*(samples[name].astype(np.int64) for name in ("sequence", "size", "sent_ns", "at_ns"))),
        begun_ns=int(started["at_ns"][0]) if len(started) else None,
        matched_ns=int(matched["at_ns"][0]) if len(matched) else None,
        refused=len(by_kind[REFUSED]),
        skipped=int(by_kind[SKIPPED]["sequence"].sum()),
        foreign=len(by_kind[FOREIGN]),
        whole=bool(len(ends)),
        kinds={kind: len(records_of_kind) for kind, records_of_kind in by_kind.items()},
        times_ns=records["at_ns"].astype(np.int64),
        numbers=offered["sequence"].astype(np.int64),
        end=int(origin["sequence"][0]) if len(origin) else None,
        topic_sum=int(origin["size"][0]) if len(origin) else None,
    )


def _is_intact(content: bytes | mmap, end: np.void, *, required: bool) -> bool:
    """Return True if the checksum in the end record is correct, or missing and not required."""
    if end["sent_ns"] != _HAS_CHECKSUM:
        return not required
    record = end.tobytes()
    starts_at = content.rfind(record)
    blank = record[:_SIZE_AT] + bytes(4) + record[_SIZE_AT + 4 :]
    return zlib.crc32(blank, zlib.crc32(memoryview(content)[:starts_at])) == int(end["size"])
