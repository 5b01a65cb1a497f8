"""Names of the installed backends, found without importing them or what they are made of."""

from importlib.metadata import entry_points
from typing import Final

ENTRY_POINTS: Final = "fieldkit.backends"


def backend_names() -> tuple[str, ...]:
    """Return the names of the installed backends."""
    return tuple(sorted(point.name for point in entry_points(group=ENTRY_POINTS)))
