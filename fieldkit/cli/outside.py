"""Commands of installed packages, listed by their entry points. A package is imported when its command is used.

`NAME = "package.module:function"` names a function that gets the command's `Parser` and declares the arguments of the
command, as `add` does in the modules of `fieldkit.cli.commands`. It must set the default `run` to
`package.module:function`, the function that runs the command.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import EntryPoint
from typing import Any

from fieldkit.cli.parser import Commands, Parser
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, FieldkitError


def add_all(commands: Commands) -> None:
    """Add a parser for each command. Its arguments are declared at first use."""
    for name, targets in sorted(names().items()):
        if name in commands.choices:
            continue  # a command of fieldkit
        packages = " and ".join(dict.fromkeys(target.partition(":")[0].partition(".")[0] for target in targets))
        add(commands, name, targets, f"of {packages}, see fieldkit {name} --help").is_foreign = True


def add(commands: Commands, name: str, targets: Sequence[str], help_line: str) -> Parser:
    """Add a parser for a command of entry points, and return it."""
    parser: Parser = commands.add_parser(name, help=help_line)
    parser.set_defaults(outside=name)
    parser.declare = partial(_declare, name, targets)
    return parser


def load(name: str, target: str) -> Any:  # noqa: ANN401 (an object of any type)
    """Return the object that `package.module:function` names.

    Raises:
        ConfigurationError: It cannot be imported.
    """
    return plugins.load(EntryPoint(name, target, plugins.COMMANDS))


def names() -> Mapping[str, Sequence[str]]:
    """Return the entry points of each command by its name. Several entry points mean that packages conflict."""
    targets: dict[str, dict[str, None]] = {}
    for point in plugins.entry_points(plugins.COMMANDS):
        targets.setdefault(point.name, {})[point.value] = None
    return {name: tuple(values) for name, values in targets.items()}


def _declare(name: str, targets: Sequence[str], parser: Parser) -> None:
    """Call the package of a command to declare its arguments.

    Raises:
        ConfigurationError: It cannot be loaded, raises an error, or another package adds a command of the same name.
    """
    if len(targets) > 1:
        raise ConfigurationError(
            f"several packages add a command {name!r}: {', '.join(targets)}", remedy="uninstall all but one"
        )
    declare: Callable[[Parser], None] = load(name, targets[0])
    try:
        declare(parser)
    except FieldkitError:
        raise
    except Exception as error:
        raise ConfigurationError(
            f"its arguments cannot be declared: {type(error).__name__}: {error}",
            where=f"entry point {name} = {targets[0]}",
            remedy=plugins.REMEDY,
        ) from error
