"""CSV of a testbed, behind a line that counts its lines, so that one that was cut does not look whole.

That line is a comment, `# lines 12`; what earlier versions wrote has none.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import reading

_COUNT: Final = re.compile(r"# lines ([0-9]{1,9})\n", re.ASCII)


def text(header: str, lines: Iterable[str]) -> str:
    """Return a header and lines as `read` reads them."""
    listed = list(lines)
    return "".join(f"{line}\n" for line in (f"# lines {len(listed)}", header, *listed))


def read(path: Path, header: str, form: re.Pattern[str], what: str) -> list[re.Match[str]]:
    """Return the lines of a file.

    Args:
        path: The file.
        header: Its first line.
        form: What every other line matches.
        what: What it does not say where it is none: `does not say where robots were`.

    Raises:
        EvidenceError: It is missing or not whole.
    """
    said = reading.text(path)
    count = _COUNT.match(said)
    first, *lines = said[count.end() if count else 0 :].split("\n")
    found = [match for line in lines[:-1] if (match := form.fullmatch(line)) is not None]
    if first != header or lines[-1:] != [""] or len(found) < len(lines) - 1:
        raise EvidenceError(what, where=str(path))
    if count and int(count[1]) != len(found):
        raise EvidenceError(f"has {len(found)} lines of {count[1]}: it was cut", where=str(path))
    return found
