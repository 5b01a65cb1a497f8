"""Logs of topics as the agent on a robot writes them (`fieldkit.agent.records`): fixed records behind a magic.

Zeros follow the last record of a log whose writer was killed: it grows by pieces.
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
_CHECKED: Final = 1
"""In an end whose size is the checksum of the log; logs of fieldkit without an origin have none."""
_SIZE_AT: Final = 4


@dataclass(frozen=True, eq=False)
class Stamped(Table):
    """Samples in the order in which they were written down; times by the clocks of two robots.

    Attributes:
        sequence: Number of each, from 0.
        size_bytes: Bytes of each, serialized.
        sent_ns: When its sender sent it, as it says itself, nanoseconds since 1970 UTC.
        at_ns: When it was taken by the middleware, or arrived, by the clock of who wrote it down.
    """

    sequence: Ints
    size_bytes: Ints
    sent_ns: Ints
    at_ns: Ints


@dataclass(frozen=True)
class TopicLog:
    """What one end wrote down.

    Attributes:
        samples: Those that the middleware took, or that arrived.
        begun_ns: When the middleware began to look for others; None where it is not told.
        matched_ns: When the other end was known; None where it never was.
        refused: Samples that the middleware did not take.
        skipped: Samples whose time passed while one before was being written.
        foreign: What arrived and is no sample of the stream.
        whole: Whether the log has its end.
        kinds: Number of records of each kind, by the number of the kind.
        times_ns: Time of every record in the order in which they were written, by the writer's clock.
        numbers: Sequence number of each sample that was offered to the middleware or that arrived, refused ones too.
        end: `PUBLISHER` or `SUBSCRIBER`; None in a log of fieldkit without an origin, which does not say.
        topic_sum: CRC-32 of the topic's name; None likewise.
    """

    samples: Stamped
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
    """Return what an end wrote down; a record that was cut in its midst is passed over, as is one without its time.

    Raises:
        EvidenceError: The file is missing, is no such log, counts other than its records, or was changed after its
            end was written.
    """
    content = reading.mapped(path)
    if content[: len(MAGIC)] != MAGIC:
        raise EvidenceError("is no log of a topic", where=str(path), remedy="repeat the measurement")
    count = (len(content) - len(MAGIC)) // RECORD_BYTES
    records = np.frombuffer(content, _RECORD, count, offset=len(MAGIC))
    records = records[records["at_ns"] != 0]
    if len(unknown := np.setdiff1d(records["kind"], _KINDS)):
        what = f"has a record of kind {unknown[0]}, which no agent writes"
        raise EvidenceError(what, where=str(path), remedy="repeat the measurement")

    of = {kind: records[records["kind"] == kind] for kind in _KINDS}
    samples, ends = of[_SAMPLE], of[_END]
    if len(ends) and (len(ends) > 1 or records["kind"][-1] != _END or ends["sequence"][0] != len(samples)):
        raise EvidenceError("counts other samples than it has", where=str(path), remedy="repeat the measurement")
    begun, matched, origin = of[BEGUN], of[MATCHED], of[_ORIGIN]
    if len(ends) and not _is_intact(content, ends[0], signed=len(origin) > 0):
        raise EvidenceError("was changed: its checksum is wrong", where=str(path), remedy="repeat the measurement")
    offered = records[(records["kind"] == _SAMPLE) | (records["kind"] == REFUSED)]
    return TopicLog(
        samples=Stamped(*(samples[name].astype(np.int64) for name in ("sequence", "size", "sent_ns", "at_ns"))),
        begun_ns=int(begun["at_ns"][0]) if len(begun) else None,
        matched_ns=int(matched["at_ns"][0]) if len(matched) else None,
        refused=len(of[REFUSED]),
        skipped=int(of[SKIPPED]["sequence"].sum()),
        foreign=len(of[FOREIGN]),
        whole=bool(len(ends)),
        kinds={kind: len(these) for kind, these in of.items()},
        times_ns=records["at_ns"].astype(np.int64),
        numbers=offered["sequence"].astype(np.int64),
        end=int(origin["sequence"][0]) if len(origin) else None,
        topic_sum=int(origin["size"][0]) if len(origin) else None,
    )


def _is_intact(content: bytes | mmap, end: np.void, *, signed: bool) -> bool:
    """Return whether the checksum in the end of a log is right; a log without an origin may have none."""
    if end["sent_ns"] != _CHECKED:
        return not signed
    record = end.tobytes()
    begins = content.rfind(record)
    blank = record[:_SIZE_AT] + bytes(4) + record[_SIZE_AT + 4 :]
    return zlib.crc32(blank, zlib.crc32(memoryview(content)[:begins])) == int(end["size"])
