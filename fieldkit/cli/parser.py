"""Parse command lines, and list the commands of installed packages by their entry points.

A usage error is raised like every other error; it suggests a similar word if there is one. A package is imported when
its command is used. An entry point `NAME = "package.module:function"` names a function that gets the command's
`Parser` and declares the arguments of the command, as `add` does in the modules of `fieldkit.cli.commands`. It must
set the default `run` to `package.module:function`, the function that runs the command.
"""

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from functools import partial
from importlib.metadata import EntryPoint
from typing import Any, Final, NoReturn

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, FieldkitError, did_you_mean

Commands = Any  # argparse has no public name for the object that add_subparsers returns

_OPTION: Final = re.compile(r"^  (?:-.*?, )?(--[a-z-]+)", re.MULTILINE)
_NEGATIVE: Final = re.compile(r"-\.?\d")


class Parser(argparse.ArgumentParser):
    """An `ArgumentParser` that raises usage errors as `ConfigurationError`, also for its subcommands.

    Attributes:
        takes_lengths: True if `-5m` is a length. Otherwise argparse parses a word that begins with a dash as an
            option, unless it is a number without a unit.
        declare: Function that declares the arguments at first use; None if they are declared already.
        is_foreign: True if another package declares the arguments. They are declared only when this command is used.
            Other commands therefore do not load the package, and an error in it does not affect them.
    """

    def __init__(self, *words: Any, **options: Any) -> None:  # noqa: ANN401 (passed to argparse unchanged)
        super().__init__(*words, **options)
        self.takes_lengths = False
        self.declare: Callable[[Parser], None] | None = None
        self.is_foreign = False
        self._commands: Commands = None
        self._words: Sequence[str] = ()
        self._is_intermixing = False

    def add_commands(self, **options: Any) -> Commands:  # noqa: ANN401 (passed to argparse unchanged)
        """Return the object of `add_subparsers`; an error about an unknown subcommand contains the most similar one.

        Without a subcommand, `run` of the parsed arguments is None, and `parser` is this parser, whose help is
        printed.
        """
        self._commands = self.add_subparsers(**options)
        self.set_defaults(run=None, parser=self)
        return self._commands

    def declare_arguments(self) -> None:
        """Declare the arguments unless they are declared already.

        Raises:
            FieldkitError: A package cannot declare them.
        """
        declare, self.declare = self.declare, None
        if declare is not None:
            declare(self)

    def subcommands(self) -> Sequence[str]:
        """Return the names of the subcommands."""
        return tuple(self._commands.choices) if self._commands else ()

    def command(self, name: str) -> "Parser | None":
        """Return the parser of a subcommand, or None if there is no such subcommand.

        Its arguments are declared, unless another package declares them.
        """
        parser: Parser | None = self._commands.choices.get(name) if self._commands else None
        if parser is not None and not parser.is_foreign:
            parser.declare_arguments()
        return parser

    def accepts(self, option: str, value: str) -> bool:
        """Return True if the parser has `option`, and `value` is not its default."""
        action = self._option_string_actions.get(option)
        return action is not None and str(action.default) != value

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> tuple[Any, list[str]]:  # type: ignore[override] # noqa: ANN401 (a namespace of any kind)
        """Parse as `ArgumentParser` does; argparse calls this for each subcommand, too.

        Raises:
            ConfigurationError: There is no such subcommand or option.
        """
        self.declare_arguments()
        words = list(sys.argv[1:] if args is None else args)
        self._words = words
        if self._commands is not None:
            self._require_command(words)
        if self.takes_lengths:
            # argparse does not parse a word with a leading space as an option. Converters of lengths
            # remove the space.
            words = [f" {word}" if _NEGATIVE.match(word) else word for word in words]
        if self._is_intermixing:
            return super().parse_known_args(words, namespace)
        arguments, unknown = super().parse_known_args(words, copy(namespace))
        if option := next((word for word in unknown if word.startswith("-")), None):
            raise self._unknown(option)
        if unknown and self._can_intermix():
            # argparse assigns words to a list only up to the next option: `compare A --force B`.
            self._is_intermixing = True
            try:
                arguments, unknown = self.parse_known_intermixed_args(words, copy(namespace))
            finally:
                self._is_intermixing = False
        if unknown:
            raise self._unknown(unknown[0])
        return arguments, unknown

    def _can_intermix(self) -> bool:
        """Return True if argparse can parse options between the words of this command."""
        grouped = {id(action) for group in self._mutually_exclusive_groups for action in group._group_actions}  # noqa: SLF001 (argparse has no public list)
        return not any(
            action.nargs in {argparse.PARSER, argparse.REMAINDER} or id(action) in grouped
            for action in self._get_positional_actions()
        )

    def _require_command(self, words: Sequence[str]) -> None:
        """Raise an error for an unknown subcommand. Only options without values can precede a subcommand."""
        for word in words:
            if word in {"-h", "--help", "--version"}:
                return
            if not word.startswith("-"):
                self._require_choice("COMMAND", word, self._commands.choices)
                return
            if word.startswith("--") and not any(option.startswith(word) for option in self._options()):
                raise self._unknown(word)

    def _unknown(self, word: str) -> ConfigurationError:
        """Return the error for an unknown word, with the most similar option."""
        name = word.partition("=")[0].lstrip("-")
        for parser in filter(None, (self, *map(self.command, self.subcommands()))):
            # Names are compared without dashes, because equal dashes make different options similar.
            options = {option.lstrip("-"): option for option in parser._options()}  # noqa: SLF001 (a method of this class)
            if similar := difflib.get_close_matches(name, options, n=1):
                command = "" if parser is self else f"{parser.prog} "
                return ConfigurationError(
                    f"{self.prog} has no option or argument {word!r}",
                    remedy=f"did you mean {command + options[similar[0]]!r}?",
                )
        return ConfigurationError(f"{self.prog} has no option or argument {word!r}", remedy=f"{self.prog} --help")

    def _options(self) -> list[str]:
        """Return the long options, read from the help because argparse has no public list."""
        return _OPTION.findall(self.format_help())

    def error(self, message: str) -> NoReturn:
        """Raise a usage error. An unknown option has priority over the errors that follow from it.

        Raises:
            ConfigurationError: Always.
        """
        for word in self._words:
            name = word.partition("=")[0]
            if name.startswith("--") and not any(option.startswith(name) for option in self._options()):
                raise self._unknown(word)
        raise ConfigurationError(message, remedy=f"{self.prog} --help")

    def add_choice(self, name: str, choices: Iterable[str], **options: Any) -> None:  # noqa: ANN401 (passed to argparse unchanged)
        """Add an argument whose value is one of `choices`; the error for another value suggests a similar choice."""
        values = tuple(choices)
        self.add_argument(
            name, choices=values, type=self._choice_converter(options.get("metavar", name), values), **options
        )

    def _choice_converter(self, name: str, choices: Sequence[str]) -> Callable[[str], str]:
        def convert(text: str) -> str:
            self._require_choice(name, text, choices)
            return text

        return convert

    def _require_choice(self, argument: str, text: str, choices: Iterable[str]) -> None:
        if text not in choices:
            raise ConfigurationError(
                f"{argument} cannot be {text!r}; it is one of: {', '.join(choices)}",
                remedy=did_you_mean(text, choices, f"{self.prog} --help"),
            )


def add_plugin_commands(commands: Commands) -> None:
    """Add a parser for each command of another package. Its arguments are declared at first use."""
    for name, targets in sorted(plugin_targets().items()):
        if name in commands.choices:
            continue  # a command of fieldkit
        packages = " and ".join(dict.fromkeys(target.partition(":")[0].partition(".")[0] for target in targets))
        add_plugin_command(commands, name, targets, f"of {packages}, see fieldkit {name} --help").is_foreign = True


def add_plugin_command(commands: Commands, name: str, targets: Sequence[str], help_line: str) -> Parser:
    """Add a parser for a command of entry points, and return it."""
    parser: Parser = commands.add_parser(name, help=help_line)
    parser.set_defaults(plugin=name)
    parser.declare = partial(_declare_plugin, name, targets)
    return parser


def load_plugin(name: str, target: str) -> Any:  # noqa: ANN401 (an object of any type)
    """Return the object that `package.module:function` names.

    Raises:
        ConfigurationError: It cannot be imported.
    """
    return plugins.load(EntryPoint(name, target, plugins.COMMANDS))


def plugin_targets() -> Mapping[str, Sequence[str]]:
    """Return the entry points of each command by its name. Several entry points mean that packages conflict."""
    targets: dict[str, dict[str, None]] = {}
    for point in plugins.entry_points(plugins.COMMANDS):
        targets.setdefault(point.name, {})[point.value] = None
    return {name: tuple(values) for name, values in targets.items()}


def _declare_plugin(name: str, targets: Sequence[str], parser: Parser) -> None:
    """Call the package of a command to declare its arguments.

    Raises:
        ConfigurationError: It cannot be loaded, raises an error, or another package adds a command of the same name.
    """
    if len(targets) > 1:
        raise ConfigurationError(
            f"several packages add a command {name!r}: {', '.join(targets)}", remedy="uninstall all but one"
        )
    declare: Callable[[Parser], None] = load_plugin(name, targets[0])
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
