"""Installed packages: their versions, and what they add through entry points, for example kinds of step."""

import sys
from collections.abc import Callable
from functools import cache
from importlib import metadata
from importlib.metadata import EntryPoint, EntryPoints
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError

BACKENDS: Final = "fieldkit.backends"
"""Entry point group of backends: `NAME = "package.module:Class"`, a `BackendFactory`."""
STEPS: Final = "fieldkit.steps"
"""Entry point group of step kinds: `NAME = "package.module:Class"`, a `Step`."""
MOTION: Final = "fieldkit.motion"
"""Entry point group of the package that moves robots. Its only entry point is `control`; see
`fieldkit.trial.running.motion_control`."""
RECORDINGS: Final = "fieldkit.recordings"
"""Entry point group of readers of recordings: `SUFFIX = "package.module:function"`, without the dot; see
`fieldkit.measure.evidence.recordings`."""
SESSION_JOBS: Final = "fieldkit.session_jobs"
"""Entry point group of jobs that run during a session (one run of fieldkit): `NAME = "package.module:function"`; see
`fieldkit.trial.session_jobs`."""
CHECKS: Final = "fieldkit.checks"
"""Entry point group of checks of a robot: `NAME = "package.module:function"`; see
`fieldkit.trial.running.preflight`."""
FLEET_CHECKS: Final = "fieldkit.fleet_checks"
"""Entry point group of checks of all robots together: `NAME = "package.module:function"`; `fieldkit check --NAME`
runs one. See `fieldkit.trial.running.preflight`."""
POSITIONS: Final = "fieldkit.positions"
"""Entry point group of readers of positions: `SUFFIX = "package.module:function"`, without the dot; see
`fieldkit.measure.positions.position_files`."""
POLICIES: Final = "fieldkit.policies"
"""Entry point group of sync policies of the co-simulation: `NAME = "package.module:Class"`, a `SyncPolicy`; see
`sim_backends.cosim.policies.registry`."""
FEDERATES: Final = "fieldkit.federates"
"""Entry point group of simulators that the co-simulation uses by name: `NAME = "package.module:OBJECT"`, a
`sim_backends.federates.named.NamedFederate`."""
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

_MOTION_SECTIONS: Final = MappingProxyType({PROFILE_SECTIONS: {"drive", "mavlink"}, PROCEDURE_SECTIONS: {"on_abort"}})
"""Sections of `fieldkit.motion` by group, for the error message in a distribution without this package."""

REMEDY: Final = "fix or uninstall its package"


def entry_points(group: str) -> list[EntryPoint]:
    """Return the entry points of a group sorted by name, without importing their targets.

    They are read once: a package that is installed in a folder of `sys.path` later is not found.
    """
    points = _selector(tuple(sys.path))(group=group)
    return sorted(points, key=lambda point: (point.name, point.value))


def owner(group: str, section: str) -> str:
    """Return the package of fieldkit that defines a section, even if it is not installed; empty if there is none."""
    return "fieldkit.motion" if section in _MOTION_SECTIONS.get(group, ()) else ""


def versions() -> dict[str, str]:
    """Return the version of fieldkit and of each package that adds backends, steps or sections."""
    groups = (BACKENDS, STEPS, PROFILE_SECTIONS, PROCEDURE_SECTIONS)
    packages = dict.fromkeys(point.dist for group in groups for point in entry_points(group))
    return {package.name: package.version for package in packages if package is not None}


def version(package: str) -> str:
    """Return the version of an installed package, or `unknown` if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def load(point: EntryPoint) -> Any:  # noqa: ANN401 (any object of another package)
    """Return the object of an entry point.

    Raises:
        ConfigurationError: The import raised any exception.
    """
    try:
        return point.load()
    except Exception as error:
        raise ConfigurationError(
            f"it cannot be loaded: {type(error).__name__}: {error}", where=location(point), remedy=REMEDY
        ) from error


@cache
def _selector(search_path: tuple[str, ...]) -> Callable[..., EntryPoints]:  # noqa: ARG001 (it is the key of the cache)
    """Return the function that selects entry points of the installed packages. Reading their metadata takes 10 ms."""
    return metadata.entry_points().select


def location(point: EntryPoint) -> str:
    """Return the description of an entry point for error messages, with the name and version of its package."""
    package = f" of {point.dist.name} {point.dist.version}" if point.dist is not None else ""
    return f"entry point {point.name} = {point.value}{package}"
