"""Installed packages: which version they are, and the backends, steps and commands that they add.

It reads the files that pip writes beside every package (PyPA: "Recording installed projects", "Entry points
specification"), once, which takes 2 ms. To import `importlib.metadata` takes 30, and every question to it 25 more.
"""

import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache, reduce
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from fieldkit.core.errors import ConfigurationError

BACKENDS: Final = "fieldkit.backends"
"""Group of the entry points that name backends: `NAME = "package.module:Class"`, a `BackendFactory`."""
STEPS: Final = "fieldkit.steps"
"""Group of those that name kinds of step beside fieldkit's own: `NAME = "package.module:Class"`, a `Step`."""
COMMANDS: Final = "fieldkit.commands"
"""Group of those that name commands: `NAME = "package.module:function"`; see `fieldkit.cli.outside`."""

REMEDY: Final = "mend or uninstall its package"


class EntryPoint(NamedTuple):
    """A name by which a package offers something.

    Attributes:
        name: The name.
        value: What it stands for: `package.module:name`.
        group: What it is offered as.
        about: Folder of what the package says of itself; empty for what is fieldkit's own.
    """

    name: str
    value: str
    group: str
    about: str = ""


def points(group: str) -> list[EntryPoint]:
    """Return the entry points of a group by name, without importing what they stand for."""
    return sorted(point for point in _all_points(tuple(sys.path)) if point.group == group)


@cache
def versions() -> Mapping[str, str]:
    """Return the version of each package that adds something, fieldkit itself among them."""
    abouts = (point.about for group in (BACKENDS, STEPS) for point in points(group))
    return MappingProxyType({_said(about, "Name"): _said(about, "Version") for about in abouts if about})


def version(package: str) -> str:
    """Return the version of an installed package, `unknown` where nothing tells it."""
    about = _packages(tuple(sys.path)).get(_normalized(package))
    return "unknown" if about is None else _said(about, "Version")


def load(point: EntryPoint) -> Any:  # noqa: ANN401 (whatever another package has there)
    """Return what an entry point stands for.

    Raises:
        ConfigurationError: It cannot be imported, whatever its package raises.
    """
    module, _, path = (part.strip() for part in point.value.partition("[")[0].partition(":"))
    try:
        return reduce(getattr, path.split(".") if path else (), import_module(module))
    except Exception as error:
        raise ConfigurationError(
            f"it cannot be loaded: {type(error).__name__}: {error}", where=where(point), remedy=REMEDY
        ) from error


def where(point: EntryPoint) -> str:
    """Return what an error calls an entry point."""
    return f"entry point {point.name} = {point.value}"


@cache
def _all_points(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    return tuple(point for about in _packages(path).values() for point in _points_of(about))


@cache
def _packages(path: tuple[str, ...]) -> Mapping[str, str]:
    """Return the folder of what each package says of itself; of two of a name Python imports the first."""
    found: dict[str, str] = {}
    for folder in path:
        with suppress(OSError), os.scandir(folder or ".") as scan:  # an archive, or not there
            for one in sorted(scan, key=lambda entry: entry.name):
                stem, suffix = os.path.splitext(one.name)  # noqa: PTH122 (thousands of names)
                if suffix in {".dist-info", ".egg-info"}:
                    found.setdefault(_normalized(stem.partition("-")[0]), one.path)
    return MappingProxyType(found)


def _normalized(package: str) -> str:
    return re.sub(r"[-_.]+", "_", package).lower()


def _points_of(about: str) -> Iterator[EntryPoint]:
    """Yield the entry points of a package; most have none."""
    try:
        text = Path(about, "entry_points.txt").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return
    group = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            group = line.strip("[]").strip()
        elif "=" in line and not line.startswith(("#", ";")):
            name, _, value = line.partition("=")
            yield EntryPoint(name.strip(), value.strip(), group, about)


def _said(about: str, key: str) -> str:
    """Return what a package says under a key of its metadata."""
    for name in ("METADATA", "PKG-INFO"):
        with suppress(OSError), Path(about, name).open(encoding="utf-8", errors="replace") as file:
            for line in file:
                said, _, value = line.partition(":")
                if said.lower() == key.lower():
                    return value.strip()
                if not line.strip():  # what follows is its description
                    break
    return "unknown"
