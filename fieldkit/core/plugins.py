"""Installed packages: their versions, and what they add through entry points, for example kinds of step."""

import sys
from functools import lru_cache
from importlib import metadata
from importlib.metadata import EntryPoint
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError

BACKENDS: Final = "fieldkit.backends"
"""Entry point group of backends: `NAME = "package.module:Class"`, a `BackendFactory`."""
STEPS: Final = "fieldkit.steps"
"""Entry point group of step kinds: `NAME = "package.module:Class"`, a `Step`."""
MOTION: Final = "fieldkit.motion"
"""Entry point group of the package that moves robots: `control`; see `fieldkit.trial.running.motion_control`."""
POSITIONS: Final = "fieldkit.positions"
"""Entry point group of readers of positions: `SUFFIX = "package.module:function"`, without the dot; see
`fieldkit.measure.positions.recorded`."""
COMMANDS: Final = "fieldkit.commands"
"""Entry point group of commands: `NAME = "package.module:function"`; see `fieldkit.cli.parser`."""
PROFILE_SECTIONS: Final = "fieldkit.profile_sections"
"""Entry point group of sections of robot profiles: `KEY = "package.module:Class"`, a
`fieldkit.config.profiles.ProfileSection`."""
PROCEDURE_SECTIONS: Final = "fieldkit.procedure_sections"
"""Entry point group of sections of procedures: `KEY = "package.module:Class"`, a
`fieldkit.trial.procedure_section.ProcedureSection`."""
PERMISSIONS: Final = "fieldkit.permissions"
"""Entry point group of permissions: `NAME = "package.module:OBJECT"`, a `fieldkit.core.permissions.Permission`."""

_OWNERS: Final = MappingProxyType(
    {
        (PROFILE_SECTIONS, "drive"): "fieldkit.motion",
        (PROFILE_SECTIONS, "mavlink"): "fieldkit.motion",
        (PROCEDURE_SECTIONS, "on_abort"): "fieldkit.motion",
    }
)
"""Package of each section that fieldkit documents, for the error message in a distribution without the package."""

REMEDY: Final = "fix or uninstall its package"


def entry_points(group: str) -> list[EntryPoint]:
    """Return the entry points of a group sorted by name, without importing their targets."""
    return sorted(_installed(tuple(sys.path)).select(group=group), key=lambda point: (point.name, point.value))


@lru_cache(maxsize=1)
def _installed(path: tuple[str, ...]) -> Any:  # noqa: ANN401, ARG001 (versions of Python differ; the cache's key)
    """Return the entry points of all packages; reading them takes about 15 ms."""
    return metadata.entry_points()


def owner(group: str, name: str) -> str:
    """Return the package of fieldkit that has an entry point, even if it is not installed; empty if it is unknown."""
    return _OWNERS.get((group, name), "")


def versions() -> dict[str, str]:
    """Return the version of each package that adds backends, steps or sections, fieldkit included."""
    groups = (BACKENDS, STEPS, PROFILE_SECTIONS, PROCEDURE_SECTIONS)
    packages = (point.dist for group in groups for point in entry_points(group))
    return {package.name: package.version for package in packages if package is not None}


def version(package: str) -> str:
    """Return the version of an installed package, or `unknown` if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def load(point: EntryPoint) -> Any:  # noqa: ANN401 (any object of another package)
    """Return the object that an entry point names.

    Raises:
        ConfigurationError: The import raised any exception.
    """
    try:
        return point.load()
    except Exception as error:
        raise ConfigurationError(
            f"it cannot be loaded: {type(error).__name__}: {error}", where=location(point), remedy=REMEDY
        ) from error


def location(point: EntryPoint) -> str:
    """Return the description of an entry point for error messages."""
    return f"entry point {point.name} = {point.value}"
