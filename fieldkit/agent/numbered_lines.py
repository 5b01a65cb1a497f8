"""Numbered lines of JSON with a checksum at the end, so that missing lines of a log are detected.

`fieldkit.measure.evidence.reading` checks them.
"""

from __future__ import annotations

import json
import zlib
from typing import IO, Any, Mapping


class NumberedLines:
    """A log of JSON objects, one per line.

    Args:
        file: The open file.
    """

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._count = self._checksum = 0

    def write(self, values: Mapping[str, Any]) -> str:
        """Write a line with its number as `n`, and return it; raises `OSError` if it cannot be written."""
        return self._append(self._numbered_line(values))

    def end(self, values: Mapping[str, Any]) -> str:
        """Write the last line and return it.

        Its last member `crc32` is the CRC-32 of all earlier lines, and of the last line without that member.

        Raises:
            OSError: The line cannot be written.
        """
        line = self._numbered_line(values)
        checksum = zlib.crc32(line.encode("ascii"), self._checksum)
        return self._append(f'{line[:-1]}, "crc32": {checksum}}}')

    def _numbered_line(self, values: Mapping[str, Any]) -> str:
        return json.dumps({"n": self._count, **values})

    def _append(self, line: str) -> str:
        self._file.write(line + "\n")
        self._file.flush()
        self._checksum = zlib.crc32((line + "\n").encode("ascii"), self._checksum)
        self._count += 1
        return line
