"""The log of a publisher or subscriber: a magic number and records of fixed size.

The log is mapped into memory. No record is lost if the program is killed, because the kernel writes the mapped pages
to the file. Writing a record needs no system call, so that logging does not delay samples. The file grows in pieces.
A piece is allocated on disk before it is mapped. A full disk therefore causes an error at that time, and not SIGBUS
when a record is written later. (A failing disk still causes SIGBUS.) If a log was not closed, zeros follow its last
record.

`fieldkit.ros.streams.topic_samples` reads these logs.
"""

from __future__ import annotations

import mmap
import os
import struct
import threading
import zlib

MAGIC = b"fieldkit topic 1"
RECORD = struct.Struct("<HHIqqq")
"""Fields of a record: kind, unused, size in bytes, sequence number, send time, local time.

Times are in nanoseconds since 1970 UTC. The local time of a record is never 0, so a record of zeros is an unused one.
"""

SAMPLE = 1
"""A sample; the send time is the time in the sample. The local time is the time after the middleware accepted the
sample (publisher), or its time of arrival (subscriber)."""
DISCOVERY_STARTED = 2
"""The middleware is imported, and its discovery starts; for a video, its pipeline is about to start."""
MATCHED = 3
"""The other endpoint was discovered; for a video, its pipeline is playing."""
REFUSED = 4
"""A sample that the middleware did not accept."""
SKIPPED = 5
"""Samples that were not sent, because writing the previous one took too long. `sequence` is how many."""
FOREIGN = 6
"""A received sample that does not belong to this stream."""
END = 7
"""The last record; `sequence` is the number of samples.

If the send time is `CHECKED`, the log has a checksum: `size` is the CRC-32 of the whole file, computed with `size` 0.
"""
WRITER = 8
"""The role of the program that writes the log: `sequence` is `PUBLISHER` or `SUBSCRIBER`, `size` is the CRC-32 of the
topic's name."""

READ = 9
"""The subscriber's program reads the newest sample, at the local time; `sequence` is -1 if none has arrived."""
UNREADABLE = 10
"""A received frame whose pixels do not contain a number and a time."""

PUBLISHER, SUBSCRIBER = 1, 2
CHECKED = 1

PIECE_BYTES = 16 * mmap.ALLOCATIONGRANULARITY
"""Size by which a log grows: about 2,000 records, 40 s of a stream at 50 Hz."""


class LogError(Exception):
    """A log cannot be written."""


class Log:
    """Writes a log; its methods may be called by several threads.

    Args:
        path: The file.

    Raises:
        LogError: The file cannot be created or allocated.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._samples = 0
        self._lock = threading.Lock()
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError as error:
            raise self._log_error(error) from error
        self._map_from(0)
        self._piece[: len(MAGIC)] = MAGIC
        self._offset = len(MAGIC)

    def note(self, kind: int, at_ns: int, *, size: int = 0, sequence: int = 0, sent_ns: int = 0) -> None:
        """Write a record.

        Raises:
            LogError: The log cannot be written, for example because the disk is full. It has all earlier records.
        """
        record = RECORD.pack(kind, 0, size, sequence, sent_ns, at_ns)
        with self._lock:
            self._write(record)
            self._samples += kind == SAMPLE

    def _write(self, record: bytes) -> None:
        end = self._offset + RECORD.size
        if end > PIECE_BYTES:
            self._map_from(self._piece_start + self._offset)
            end = self._offset + RECORD.size
        self._piece[self._offset : end] = record
        self._offset = end

    def write_role(self, at_ns: int, role: int, topic: str) -> None:
        """Write a `WRITER` record.

        Args:
            at_ns: The local time.
            role: `PUBLISHER` or `SUBSCRIBER`.
            topic: The topic's name.

        Raises:
            LogError: The disk is full.
        """
        self.note(WRITER, at_ns, size=zlib.crc32(topic.encode()), sequence=role)

    def end(self, at_ns: int) -> None:
        """Write the last record with a checksum, and flush the file to disk.

        Raises:
            LogError: The disk is full.
        """
        with self._lock:
            unchecked_record = RECORD.pack(END, 0, 0, self._samples, CHECKED, at_ns)
            self._write(RECORD.pack(END, 0, self._checksum(unchecked_record), self._samples, CHECKED, at_ns))
            self._piece.close()
            os.ftruncate(self._file, self._piece_start + self._offset)
            os.fsync(self._file)
            os.close(self._file)

    def _checksum(self, end_record: bytes) -> int:
        """Return the CRC-32 of the written file and its last record; the file is read piece by piece."""
        crc, offset, size = 0, 0, self._piece_start + self._offset
        while offset < size:
            piece = os.pread(self._file, min(PIECE_BYTES, size - offset), offset)
            crc, offset = zlib.crc32(piece, crc), offset + len(piece)
        return zlib.crc32(end_record, crc)

    def _map_from(self, position: int) -> None:
        """Map the piece of the log that starts at the page of `position`, at which the next record is written."""
        offset = position % mmap.ALLOCATIONGRANULARITY
        piece_start = position - offset
        try:
            os.posix_fallocate(self._file, piece_start, PIECE_BYTES)
            self._piece = mmap.mmap(self._file, PIECE_BYTES, offset=piece_start)
        except OSError as error:
            raise self._log_error(error) from error
        self._piece_start, self._offset = piece_start, offset

    def _log_error(self, error: OSError) -> LogError:
        return LogError(f"the log {self._path} cannot be written: {error.strerror}")
