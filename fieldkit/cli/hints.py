"""Add the operator's options to the commands in remedies and hints, so that they can be typed as they are shown.

The code that creates a remedy has no access to the command line. This module adds the options of the command line.
"""

import argparse
import re
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

from fieldkit.cli.parser import Parser
from fieldkit.core import permissions

_REPEATED_OPTIONS: Final = ("site", "backend", "topology", "protocol", "repeats", "record")
"""Options that select robots and measurements, by their names in the namespace of argparse."""

# Words in lower case: a command of fieldkit, and perhaps its subcommand, such as `lab up`.
_COMMAND: Final = re.compile(r"\bfieldkit(?P<words>(?: [a-z][a-z-]*)+)[^;\n`]*")


class CliOptions:
    """The options that the operator gave and that remedies repeat.

    Args:
        parser: The parser of the whole command line.
    """

    def __init__(self, parser: Parser) -> None:
        self._parser = parser
        self._options: list[tuple[str, str]] = []

    def read(self, arguments: argparse.Namespace) -> None:
        """Store the parsed arguments that remedies repeat."""
        for name in _REPEATED_OPTIONS:
            value = getattr(arguments, name, None)
            values = value if isinstance(value, list) else [] if value is None else [value]
            self._options += [(f"--{name}", str(item)) for item in values]
        if granted_names := permissions.granted(arguments):
            self._options += [(permissions.option(name), "") for name in permissions.repeated(granted_names)]

    def add(self, options: Iterable[tuple[str, str]]) -> None:
        """Store options with their values, for example those of an earlier command."""
        self._options += options

    def add_to_command(self, match: re.Match[str]) -> str:
        """Return the matched command with the stored options that it accepts and does not contain."""
        parser, words = self._parser, list[str]()
        for word in match["words"].split():
            subparser = parser.command(word)
            if subparser is None:
                break
            parser, words = subparser, [*words, word]
        missing = [
            shlex.join((option, value) if value else (option,))
            for option, value in self._options
            if parser.accepts(option, value) and f"{option} " not in f"{match[0]} "
        ]
        if not words or not missing:
            return match[0]
        command = f"fieldkit {' '.join(words)}"
        return f"{command} {' '.join(missing)}{match[0].removeprefix(command)}"


_options: ContextVar[CliOptions | None] = ContextVar("options", default=None)


@contextmanager
def adding_options(parser: Parser) -> Iterator[CliOptions]:
    """Yield an object that stores options. While the body runs, `add_options` adds these options to commands."""
    options = CliOptions(parser)
    token = _options.set(options)
    try:
        yield options
    finally:
        _options.reset(token)


def repeat_options(given: Iterable[tuple[str, str]]) -> None:
    """Let `add_options` also add these options with their values, until the end of the command."""
    if (options := _options.get()) is not None:
        options.add(given)


def add_options(text: str) -> str:
    """Return a text with the operator's options added to its fieldkit commands."""
    options = _options.get()
    return text if options is None else _COMMAND.sub(options.add_to_command, text)
