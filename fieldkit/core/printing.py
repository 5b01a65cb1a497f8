"""Plain text on standard output, for commands without tables, colours or a live line."""

import sys

from fieldkit.core.text import sanitized


def print_text(text: object = "", *, end: str = "\n", flush: bool = False) -> None:
    """Print a text with its control characters replaced, except tabs, which files that are shown may contain."""
    sys.stdout.write("\t".join(map(sanitized, str(text).split("\t"))) + end)
    if flush:
        sys.stdout.flush()
