"""Logs of topics as the agent on a robot writes them (`fieldkit.agent.records`): fixed records behind a magic.

Zeros follow the last record of a log whose writer was killed: it grows by pieces.
"""

from dataclasses import dataclass
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

_SAMPLE, _BEGUN, _MATCHED, _REFUSED, _SKIPPED, _FOREIGN, _END = range(1, 8)


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
    """

    samples: Stamped
    begun_ns: int | None
    matched_ns: int | None
    refused: int
    skipped: int
    foreign: int
    whole: bool


def read(path: Path) -> TopicLog:
    """Return what an end wrote down; a record that was cut in its midst is passed over, as is one without its time.

    Raises:
        EvidenceError: The file is missing, is no such log, or counts other than its records.
    """
    content = reading.mapped(path)
    if content[: len(MAGIC)] != MAGIC:
        raise EvidenceError("is no log of a topic", where=str(path), remedy="repeat the measurement")
    count = (len(content) - len(MAGIC)) // RECORD_BYTES
    records = np.frombuffer(content, _RECORD, count, offset=len(MAGIC))
    records = records[records["at_ns"] != 0]

    of = {kind: records[records["kind"] == kind] for kind in range(_SAMPLE, _END + 1)}
    samples, ends = of[_SAMPLE], of[_END]
    if len(ends) and (len(ends) > 1 or records["kind"][-1] != _END or ends["sequence"][0] != len(samples)):
        raise EvidenceError("counts other samples than it has", where=str(path), remedy="repeat the measurement")
    begun, matched = of[_BEGUN], of[_MATCHED]
    return TopicLog(
        samples=Stamped(*(samples[name].astype(np.int64) for name in ("sequence", "size", "sent_ns", "at_ns"))),
        begun_ns=int(begun["at_ns"][0]) if len(begun) else None,
        matched_ns=int(matched["at_ns"][0]) if len(matched) else None,
        refused=len(of[_REFUSED]),
        skipped=int(of[_SKIPPED]["sequence"].sum()),
        foreign=len(of[_FOREIGN]),
        whole=bool(len(ends)),
    )
