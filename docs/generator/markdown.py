"""Markdown of the reference pages."""

import re
from collections.abc import Iterable, Sequence
from typing import Final

_PAGE_LINK: Final = re.compile(r"\]\((?=[a-z][\w/-]*\.md)")
_FOLDER: Final = "](reference/"


def relative(text: str) -> str:
    """Return a text with its links, which are relative to `docs/`, made relative to `docs/reference/`."""
    return _PAGE_LINK.sub("](../", text).replace("](../reference/", "](")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(map(_cell, line))} |\n" for line in lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def page(title: str, *blocks: str) -> str:
    """Return a page of blocks, with the note that it is generated."""
    note = "<!-- Written by `python -m docs.generator` from the code; edit the code. -->"
    return "\n\n".join((note, f"# {title}", *(block.strip("\n") for block in blocks if block.strip()))) + "\n"
