"""Backends and kinds of step of installed packages, found by their entry points, and how any of these is loaded."""

from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError

BACKENDS: Final = "fieldkit.backends"
"""Group of the entry points that name backends: `NAME = "package.module:Class"`, a `BackendFactory`."""
STEPS: Final = "fieldkit.steps"
"""Group of those that name kinds of step beside fieldkit's own: `NAME = "package.module:Class"`, a `Step`."""
COMMANDS: Final = "fieldkit.commands"
"""Group of those that name commands: `NAME = "package.module:function"`; `fieldkit.cli.outside` finds them."""

REMEDY: Final = "mend or uninstall its package"


def points(group: str) -> list[EntryPoint]:
    """Return the entry points of a group by name, without importing what they stand for."""
    return sorted(entry_points(group=group), key=lambda point: point.name)


@cache
def versions() -> Mapping[str, str]:
    """Return the version of each package that adds something, fieldkit itself among them."""
    packages = (point.dist for group in (BACKENDS, STEPS) for point in points(group))
    return MappingProxyType({package.name: package.version for package in packages if package is not None})


def load(point: EntryPoint) -> Any:  # noqa: ANN401 (whatever another package has there)
    """Return what an entry point stands for.

    Raises:
        ConfigurationError: It cannot be imported, whatever its package raises.
    """
    try:
        return point.load()
    except Exception as error:
        raise ConfigurationError(
            f"it cannot be loaded: {type(error).__name__}: {error}", where=where(point), remedy=REMEDY
        ) from error


def where(point: EntryPoint) -> str:
    """Return what an error calls an entry point."""
    return f"entry point {point.name} = {point.value}"
