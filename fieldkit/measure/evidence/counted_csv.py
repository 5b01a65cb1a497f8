"""CSV files of a testbed whose first line is the number of lines, so that truncation can be detected.

That line is a comment, `# lines 12`; files of earlier versions do not have it.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import reading

_COUNT: Final = re.compile(r"# lines ([0-9]{1,9})\n", re.ASCII)


def text(header: str, lines: Iterable[str]) -> str:
    """Return the text of a file with this header and these lines."""
    listed = list(lines)
    return "".join(f"{line}\n" for line in (f"# lines {len(listed)}", header, *listed))


def read(path: Path, header: str, pattern: re.Pattern[str], error: str) -> list[re.Match[str]]:
    """Return the matches of a pattern with the lines of a file.

    Args:
        path: The file.
        header: Its header line.
        pattern: Pattern that all other lines must match.
        error: Message if they do not: `is not a track of robots`.

    Raises:
        EvidenceError: The file is missing, truncated, or has other contents.
    """
    content = reading.text(path)
    count = _COUNT.match(content)
    first, *lines = content[count.end() if count else 0 :].split("\n")
    matches = [match for line in lines[:-1] if (match := pattern.fullmatch(line)) is not None]
    if first != header or lines[-1:] != [""] or len(matches) < len(lines) - 1:
        raise EvidenceError(error, where=str(path))
    if count and int(count[1]) != len(matches):
        raise EvidenceError(f"has {len(matches)} lines of {count[1]}: truncated", where=str(path))
    return matches
