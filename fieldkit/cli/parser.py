"""Parse command lines; a typing error is told as every other error is, with what was perhaps meant."""

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NoReturn

from fieldkit.core.errors import ConfigurationError, nearest

Commands = Any  # argparse has no public name for the object that add_subparsers returns

_OPTION: Final = re.compile(r"^  (?:-.*?, )?(--[a-z-]+)", re.MULTILINE)
_NEGATIVE: Final = re.compile(r"-\.?\d")


class Parser(argparse.ArgumentParser):
    """An `ArgumentParser` whose errors are `ConfigurationError`s; so are those of its subcommands.

    Attributes:
        takes_lengths: Whether `-5m` is a length: argparse takes what begins with a dash for an option, unless it is a
            number without a unit.
        declare: Declares what it takes, called when it is used first; None where that is known from the start.
        is_foreign: Whether a package declares it: no other command waits for the package, or breaks with it.
    """

    def __init__(self, *words: Any, **options: Any) -> None:  # noqa: ANN401 (as they come)
        super().__init__(*words, **options)
        self.takes_lengths = False
        self.declare: Callable[[Parser], None] | None = None
        self.is_foreign = False
        self._commands: Commands = None
        self._words: Sequence[str] = ()

    def add_commands(self, **options: Any) -> Commands:  # noqa: ANN401 (as they come)
        """Return what `add_subparsers` returns; a subcommand that is not there is then told with the nearest.

        Without one, `run` of the parsed arguments is None and `parser` is this one, whose help is wanted.
        """
        self._commands = self.add_subparsers(**options)
        self.set_defaults(run=None, parser=self)
        return self._commands

    def complete(self) -> None:
        """Let it know what it takes, if it does not yet.

        Raises:
            FieldkitError: That cannot be had.
        """
        declare, self.declare = self.declare, None
        if declare is not None:
            declare(self)

    def subcommands(self) -> Sequence[str]:
        """Return the names of its subcommands."""
        return tuple(self._commands.choices) if self._commands else ()

    def command(self, name: str) -> "Parser | None":
        """Return the parser of a subcommand, None where there is none of this name.

        It knows what it takes, unless a package has yet to declare it.
        """
        parser: Parser | None = self._commands.choices.get(name) if self._commands else None
        if parser is not None and not parser.is_foreign:
            parser.complete()
        return parser

    def takes(self, option: str, value: str) -> bool:
        """Return whether `option` may be given, with this value as its own and not as its default."""
        action = self._option_string_actions.get(option)
        return action is not None and str(action.default) != value

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> tuple[Any, list[str]]:  # type: ignore[override] # noqa: ANN401 (a namespace of any kind)
        """See `ArgumentParser.parse_known_args`; argparse calls it for each subcommand, too.

        Raises:
            ConfigurationError: There is no such subcommand or option.
        """
        self.complete()
        words = list(sys.argv[1:] if args is None else args)
        self._words = words
        if self._commands is not None:
            self._demand_command(words)
        if self.takes_lengths:
            # A word that begins with a space is no option; converters of lengths strip it.
            words = [f" {word}" if _NEGATIVE.match(word) else word for word in words]
        arguments, unknown = super().parse_known_args(words, namespace)
        if unknown:
            raise self._unknown(unknown[0])
        return arguments, unknown

    def _demand_command(self, words: Sequence[str]) -> None:
        """Refuse a subcommand that is not there: before it stand options alone, none of which has a value."""
        for word in words:
            if word in {"-h", "--help", "--version"}:
                return
            if not word.startswith("-"):
                self._one_of("COMMAND", word, self._commands.choices)
                return
            if word.startswith("--") and not any(option.startswith(word) for option in self._options()):
                raise self._unknown(word)

    def _unknown(self, word: str) -> ConfigurationError:
        """Return the error for a word that is not taken, with the option that is perhaps meant."""
        name = word.partition("=")[0]
        for parser in filter(None, (self, *map(self.command, self.subcommands()))):
            if near := difflib.get_close_matches(name, parser._options(), n=1):  # noqa: SLF001 (of another Parser)
                command = "" if parser is self else f"{parser.prog} "
                return ConfigurationError(
                    f"{self.prog} does not take {word!r}", remedy=f"did you mean {command + near[0]!r}?"
                )
        return ConfigurationError(f"{self.prog} does not take {word!r}", remedy=f"{self.prog} --help")

    def _options(self) -> list[str]:
        """Return the long options, as the help lists them: argparse has no public list."""
        return _OPTION.findall(self.format_help())

    def error(self, message: str) -> NoReturn:
        """Raise what was typed wrong: an option that is not there before all that argparse misses because of it.

        Raises:
            ConfigurationError: Always.
        """
        for word in self._words:
            name = word.partition("=")[0]
            if name.startswith("--") and not any(option.startswith(name) for option in self._options()):
                raise self._unknown(word)
        raise ConfigurationError(message, remedy=f"{self.prog} --help")

    def add_choice(self, name: str, choices: Iterable[str], **options: Any) -> None:  # noqa: ANN401 (as they come)
        """Add an argument with a value of `choices`; another one is told with the nearest."""
        known = tuple(choices)
        self.add_argument(name, choices=known, type=self._choice(options.get("metavar", name), known), **options)

    def _choice(self, name: str, known: Sequence[str]) -> Callable[[str], str]:
        def converted(text: str) -> str:
            self._one_of(name, text, known)
            return text

        return converted

    def _one_of(self, what: str, typed: str, known: Iterable[str]) -> None:
        if typed not in known:
            raise ConfigurationError(
                f"{what} cannot be {typed!r}; it is one of: {', '.join(known)}",
                remedy=nearest(typed, known, f"{self.prog} --help"),
            )
