"""Listing of robot profiles and procedures."""

from collections.abc import Callable

from fieldkit.cli.display import table
from fieldkit.config import locations
from fieldkit.core.printing import say


def list_or_show(kind: locations.Kind, summary: Callable[[str], str], name: str | None) -> int:
    """List all of `kind`, or show the file of the one named."""
    if name is None:
        rows = [(one, str(path), summary(one)) for one, path in locations.names(kind).items()]
        table(("name", "file", "summary"), rows)  # the last may be folded, which breaks a path
    else:
        summary(name)  # a file with an error is not shown as if it were good
        say(locations.find(kind, name).read_text(encoding="utf-8"), end="")
    return 0
