"""Print on standard output: the one way for commands that need no table, colour or live line."""

import sys

from fieldkit.core.text import harmless


def say(text: object = "", *, end: str = "\n", flush: bool = False) -> None:
    """Print a text without control characters; a tab stays, because files that are shown may have some."""
    sys.stdout.write("\t".join(map(harmless, str(text).split("\t"))) + end)
    if flush:
        sys.stdout.flush()
