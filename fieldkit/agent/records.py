"""The log of one end of a topic: fixed records behind a magic, each stored at once, so that a kill loses none.

The log is mapped into memory. A store into it is the kernel's as soon as it is made, as what `write` is given, and
takes no call of the kernel; the way of a sample is not held up by its record. The file grows by pieces whose room on
disk is reserved before they are mapped: a full disk is told by an error then, and not by a signal later, as one that
fails is. What follows the last record of a log that was not ended is zeros.

`fieldkit.measure.transfers.topic_log` reads it.
"""

from __future__ import annotations

import mmap
import os
import struct
import threading

MAGIC = b"fieldkit topic 1"
RECORD = struct.Struct("<HHIqqq")
"""Kind, nothing, size in bytes, sequence number, time when it was sent, time here; nanoseconds since 1970 UTC.

Only a record that is not there has 0 for the time here.
"""

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

PIECE_BYTES = 16 * mmap.ALLOCATIONGRANULARITY
"""By which a log grows: some 2,000 records, 40 s of a stream at 50 Hz."""


class LogError(Exception):
    """A log cannot be written."""


class Log:
    """A log that is being written, by any number of threads.

    Args:
        path: Where to.

    Raises:
        LogError: There is no room for it, or it may not be written there.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._samples = 0
        self._lock = threading.Lock()
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError as error:
            raise self._told(error) from error
        self._map_from(0)
        self._piece[: len(MAGIC)] = MAGIC
        self._at = len(MAGIC)

    def note(self, kind: int, at_ns: int, *, size: int = 0, sequence: int = 0, sent_ns: int = 0) -> None:
        """Write a record.

        Raises:
            LogError: The disk is full. The log has all that was noted before.
        """
        record = RECORD.pack(kind, 0, size, sequence, sent_ns, at_ns)
        with self._lock:
            end = self._at + RECORD.size
            if end > PIECE_BYTES:
                self._map_from(self._begins + self._at)
                end = self._at + RECORD.size
            self._piece[self._at : end] = record
            self._at = end
            self._samples += kind == SAMPLE

    def end(self, at_ns: int) -> None:
        """Write that nothing follows, and see that it is on disk.

        Raises:
            LogError: The disk is full.
        """
        self.note(END, at_ns, sequence=self._samples)
        with self._lock:
            self._piece.close()
            os.ftruncate(self._file, self._begins + self._at)
            os.fsync(self._file)
            os.close(self._file)

    def _map_from(self, position: int) -> None:
        """Map a piece of the log that begins at a position, or at the page that this is in."""
        at = position % mmap.ALLOCATIONGRANULARITY
        begins = position - at
        try:
            os.posix_fallocate(self._file, begins, PIECE_BYTES)
            self._piece = mmap.mmap(self._file, PIECE_BYTES, offset=begins)
        except OSError as error:
            raise self._told(error) from error
        self._begins, self._at = begins, at

    def _told(self, error: OSError) -> LogError:
        return LogError(f"the log {self._path} cannot be written: {error.strerror}")
