"""Commands of installed packages, found by their entry points; a package is imported when its command is used.

`NAME = "package.module:function"` names a function that gets the command's `Parser` and declares what it takes, as
`commands` does for fieldkit's own. `run` of the parsed arguments, `package.module:function` too, runs the command.
"""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

from fieldkit.cli.parser import Commands, Parser
from fieldkit.core.errors import ConfigurationError, FieldkitError

GROUP: Final = "fieldkit.commands"
"""`plugins.COMMANDS`, which a test compares."""


def add_all(commands: Commands) -> None:
    """Add a parser for each command; it learns what it takes when it is used first."""
    for name, targets in sorted(names().items()):
        if name in commands.choices:
            continue  # fieldkit's own
        packages = " and ".join(dict.fromkeys(target.partition(":")[0].partition(".")[0] for target in targets))
        parser: Parser = commands.add_parser(name, help=f"of {packages}, see fieldkit {name} --help")
        parser.set_defaults(outside=name)
        parser.declare = partial(_declare, name, targets)


def load(name: str, target: str) -> Any:  # noqa: ANN401 (whatever another package has there)
    """Return what `package.module:function` of a command's package stands for.

    Raises:
        ConfigurationError: It cannot be imported.
    """
    from importlib.metadata import EntryPoint  # noqa: PLC0415 (takes 30 ms)

    from fieldkit.core import plugins  # noqa: PLC0415 (the same)

    return plugins.load(EntryPoint(name, target, plugins.COMMANDS))


def names() -> Mapping[str, Sequence[str]]:
    """Return the commands that packages add, each with what its entry points stand for: several where packages clash.

    It reads the files that pip writes beside every package, which takes 1 to 2 ms. Importing `importlib.metadata`
    takes 30, which every start of fieldkit would take.
    """
    found: dict[str, dict[str, None]] = {}
    for folder in sys.path:
        for text in _entry_points(folder or "."):
            for name, target in _in_group(text):
                found.setdefault(name, {})[target] = None
    return {name: tuple(targets) for name, targets in found.items()}


def _entry_points(folder: str) -> Iterator[str]:
    """Yield what packages in a folder of `sys.path` say of their entry points."""
    try:
        with os.scandir(folder) as scan:
            abouts = sorted(one.path for one in scan if one.name.endswith((".dist-info", ".egg-info")))
    except OSError:
        return  # no folder: an archive, or not there
    for about in abouts:
        with suppress(OSError, UnicodeDecodeError):  # most have none
            yield Path(about, "entry_points.txt").read_text(encoding="utf-8")


def _in_group(text: str) -> Iterator[tuple[str, str]]:
    group = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            group = line.strip("[]").strip()
        elif group == GROUP and "=" in line and not line.startswith("#"):
            name, _, target = line.partition("=")
            yield name.strip(), target.strip()


def _declare(name: str, targets: Sequence[str], parser: Parser) -> None:
    """Let the package of a command declare what it takes.

    Raises:
        ConfigurationError: It cannot be loaded, raises something, or another package adds a command of this name.
    """
    if len(targets) > 1:
        raise ConfigurationError(
            f"several packages add a command {name!r}: {', '.join(targets)}", remedy="uninstall all but one"
        )
    add: Callable[[Parser], None] = load(name, targets[0])
    try:
        add(parser)
    except FieldkitError:
        raise
    except Exception as error:
        raise ConfigurationError(
            f"it cannot say what it takes: {type(error).__name__}: {error}",
            where=f"entry point {name} = {targets[0]}",
            remedy="mend or uninstall its package",
        ) from error
