"""Check that a log of numbered JSON lines is complete and unchanged (`fieldkit.agent.numbered_lines`)."""

import json
import re
import zlib
from pathlib import Path
from typing import Any, Final

from fieldkit.core.text import JSON_ERRORS
from fieldkit.measure.evidence import reading

_END: Final = re.compile(r'(.*), "crc32": ([0-9]{1,10})\}', re.ASCII)


def problem(path: Path) -> str | None:
    """Return why a log is not complete; None if it is, or if its lines have no numbers, as in older versions.

    Raises:
        EvidenceError: As `reading.text`.
    """
    text = reading.text(path)
    lines = text.splitlines(keepends=True)
    numbers = [_number(line) for line in lines]
    if all(number is None for number in numbers):
        return None
    if numbers != list(range(len(lines))):
        return "its lines are not numbered without a gap: some are missing or were changed"
    end = _END.fullmatch(lines[-1].rstrip("\n"))
    if end is None or not lines[-1].endswith("\n"):
        return "its last line is missing: its writer was killed"
    head = "".join(lines[:-1]) + end[1] + "}"
    return (
        None if zlib.crc32(head.encode("utf-8", "replace")) == int(end[2]) else "was changed: its checksum is wrong"
    )


def _number(line: str) -> int | None:
    try:
        value: Any = json.loads(line)
    except JSON_ERRORS:
        return None
    number = value.get("n") if isinstance(value, dict) else None
    return number if type(number) is int else None
