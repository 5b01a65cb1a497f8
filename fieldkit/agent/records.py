"""The log of one end of a topic: fixed records behind a magic, each written at once, so that a kill loses none.

`fieldkit.measure.transfers.topic_log` reads it.
"""

from __future__ import annotations

import os
import struct
from typing import BinaryIO

MAGIC = b"fieldkit topic 1"
RECORD = struct.Struct("<HHIqqq")
"""Kind, nothing, size in bytes, sequence number, time when it was sent, time here; nanoseconds since 1970 UTC."""

SAMPLE = 1
"""A sample that was sent, with the times in it and when the middleware had taken it; or that arrived, and when."""
BEGUN = 2
"""The middleware, which is loaded, begins to look for others."""
MATCHED = 3
"""The other end is known."""
REFUSED = 4
"""A sample that the middleware did not take."""
SKIPPED = 5
"""Samples whose time passed while one before was being written; `sequence` is their number."""
FOREIGN = 6
"""Something arrived that is no sample of this stream."""
END = 7
"""Nothing follows; `sequence` is the number of samples."""


class Log:
    """A log that is being written.

    Args:
        path: Where to.
    """

    def __init__(self, path: str) -> None:
        self._file: BinaryIO = open(path, "wb", buffering=0)  # noqa: SIM115, PTH123 (closed by `end`)
        self._file.write(MAGIC)
        self._samples = 0

    def note(self, kind: int, at_ns: int, *, size: int = 0, sequence: int = 0, sent_ns: int = 0) -> None:
        """Write a record."""
        self._samples += kind == SAMPLE
        self._file.write(RECORD.pack(kind, 0, size, sequence, sent_ns, at_ns))

    def end(self, at_ns: int) -> None:
        """Write that nothing follows, and see that it is on disk."""
        self.note(END, at_ns, sequence=self._samples)
        os.fsync(self._file.fileno())
        self._file.close()
