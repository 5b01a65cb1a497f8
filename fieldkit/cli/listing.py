"""Listing of robot profiles and procedures."""

from collections.abc import Callable

from fieldkit.cli.display import table
from fieldkit.config import locations
from fieldkit.core.text import print_text


def list_or_show(kind: locations.Kind, summary: Callable[[str], str], name: str | None) -> int:
    """List all files of `kind`, or show the file called `name`."""
    if name is None:
        rows = [(item, str(path), summary(item)) for item, path in locations.names(kind).items()]
        table(("name", "file", "summary"), rows)  # only the last column may be folded; a path must not be
    else:
        summary(name)  # raises if the file has an error
        print_text(locations.find(kind, name).read_text(encoding="utf-8"), end="")
    return 0
