"""Commands of installed packages, found by their entry points; a package is imported when its command is used.

`NAME = "package.module:function"` names a function that gets the command's `Parser` and declares what it takes, as
`arguments` does for fieldkit's own. `run` of the parsed arguments, `package.module:function` too, runs the command.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import EntryPoint
from typing import Any

from fieldkit.cli.parser import Commands, Parser
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, FieldkitError


def add_all(commands: Commands) -> None:
    """Add a parser for each command; it learns what it takes when it is used first."""
    for name, targets in sorted(names().items()):
        if name in commands.choices:
            continue  # fieldkit's own
        packages = " and ".join(dict.fromkeys(target.partition(":")[0].partition(".")[0] for target in targets))
        parser: Parser = commands.add_parser(name, help=f"of {packages}, see fieldkit {name} --help")
        parser.set_defaults(outside=name)
        parser.is_foreign = True
        parser.declare = partial(_declare, name, targets)


def load(name: str, target: str) -> Any:  # noqa: ANN401 (whatever another package has there)
    """Return what `package.module:function` of a command's package stands for.

    Raises:
        ConfigurationError: It cannot be imported.
    """
    return plugins.load(EntryPoint(name, target, plugins.COMMANDS))


def names() -> Mapping[str, Sequence[str]]:
    """Return the commands that packages add, and what each stands for: several things where packages clash."""
    found: dict[str, dict[str, None]] = {}
    for point in plugins.points(plugins.COMMANDS):
        found.setdefault(point.name, {})[point.value] = None
    return {name: tuple(targets) for name, targets in found.items()}


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
            remedy=plugins.REMEDY,
        ) from error
