"""Permissions that installed packages define, and that the operator gives by options `--allow-NAME`.

An entry point of the group `fieldkit.permissions` has the name of the permission, and its object is a `Permission`.
"""

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from fieldkit.core import plugins


@dataclass(frozen=True)
class Permission:
    """A permission.

    Attributes:
        help_line: What it allows, for the help of commands.
        is_repeated: Whether the commands in remedies contain the option, because a resumed trial needs it again.
    """

    help_line: str
    is_repeated: bool = False


def option(name: str) -> str:
    """Return the option that gives a permission."""
    return f"--allow-{name}"


def installed() -> Mapping[str, Permission]:
    """Return the permissions of installed packages by name.

    Raises:
        ConfigurationError: A permission cannot be loaded.
    """
    return {point.name: plugins.load(point) for point in plugins.entry_points(plugins.PERMISSIONS)}


def repeated(names: Iterable[str]) -> list[str]:
    """Return the names of the permissions among `names` that commands in remedies repeat, sorted."""
    permissions = installed()
    return sorted(name for name in names if permissions[name].is_repeated)


def granted(arguments: argparse.Namespace) -> frozenset[str]:
    """Return the names of the permissions that the operator gave; empty for a command without these options."""
    names = (point.name for point in plugins.entry_points(plugins.PERMISSIONS))
    return frozenset(name for name in names if getattr(arguments, f"allow_{name.replace('-', '_')}", False))
