"""Lines of JSON that are numbered, and end with a checksum, so that a log shows what it lacks.

`fieldkit.measure.evidence.numbered_lines` checks them.
"""

from __future__ import annotations

import json
import zlib
from typing import IO, Any, Mapping


class NumberedLines:
    """A log of JSON objects, a line each.

    Args:
        lines: The open file.
    """

    def __init__(self, lines: IO[str]) -> None:
        self._lines = lines
        self._count = self._sum = 0

    def write(self, said: Mapping[str, Any]) -> str:
        """Write a line, with its number as `n`, and return it; raises `OSError` if it cannot be written."""
        return self._put(self._numbered(said))

    def end(self, said: Mapping[str, Any]) -> str:
        """Write the last line, and return it: `crc32` is the CRC-32 of all before that member; raises as `write`."""
        line = self._numbered(said)
        total = zlib.crc32(line.encode("ascii"), self._sum)
        return self._put(f'{line[:-1]}, "crc32": {total}}}')

    def _numbered(self, said: Mapping[str, Any]) -> str:
        return json.dumps({"n": self._count, **said})

    def _put(self, line: str) -> str:
        self._lines.write(line + "\n")
        self._lines.flush()
        self._sum = zlib.crc32((line + "\n").encode("ascii"), self._sum)
        self._count += 1
        return line
