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
import zlib

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
"""Nothing follows; `sequence` is the number of samples.

With `CHECKED` in place of the time when it was sent, `size` is the CRC-32 of the whole file with 0 in that field.
"""
ORIGIN = 8
"""The end of the topic that writes the log, `PUBLISHER` or `SUBSCRIBER`, as `sequence`; `size` is the CRC-32 of the
topic's name."""

PUBLISHER, SUBSCRIBER = 1, 2
CHECKED = 1

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
            self._write(record)
            self._samples += kind == SAMPLE

    def _write(self, record: bytes) -> None:
        end = self._at + RECORD.size
        if end > PIECE_BYTES:
            self._map_from(self._begins + self._at)
            end = self._at + RECORD.size
        self._piece[self._at : end] = record
        self._at = end

    def origin(self, at_ns: int, end: int, topic: str) -> None:
        """Write which end of which topic writes this log; see `ORIGIN`.

        Raises:
            LogError: As `note`.
        """
        self.note(ORIGIN, at_ns, size=zlib.crc32(topic.encode()), sequence=end)

    def end(self, at_ns: int) -> None:
        """Write that nothing follows, with a checksum, and see that it is on disk.

        Raises:
            LogError: The disk is full.
        """
        with self._lock:
            blank = RECORD.pack(END, 0, 0, self._samples, CHECKED, at_ns)
            self._write(RECORD.pack(END, 0, self._sum(blank), self._samples, CHECKED, at_ns))
            self._piece.close()
            os.ftruncate(self._file, self._begins + self._at)
            os.fsync(self._file)
            os.close(self._file)

    def _sum(self, end: bytes) -> int:
        """Return the CRC-32 of what was written and the end of it; the file is read piece by piece."""
        total, at, size = 0, 0, self._begins + self._at
        while at < size:
            piece = os.pread(self._file, min(PIECE_BYTES, size - at), at)
            total, at = zlib.crc32(piece, total), at + len(piece)
        return zlib.crc32(end, total)

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
