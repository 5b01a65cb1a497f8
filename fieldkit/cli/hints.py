"""Commands in remedies and hints, completed by what the operator gave, so that they can be typed as they are shown.

Who words a remedy knows neither the site file's name nor the command line; here both are known.
"""

import argparse
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

from fieldkit.cli.parser import Parser

_CARRIED: Final = ("site", "backend", "topology", "protocol", "repeats", "record")
"""Options that say which robots, and what is tried on them, by the name under which argparse keeps them."""
_CARRIED_FLAGS: Final = ("allow_motion",)
"""Options without a value, without which a trial that was begun with them is not resumed."""

# Words in small letters: a command of fieldkit, and one of `fieldkit lab`.
_COMMAND: Final = re.compile(r"\bfieldkit(?P<words>(?: [a-z][a-z-]*)+)(?P<rest>[^;\n`]*)")


class Given:
    """What the operator gave.

    Args:
        parser: Of the whole command line.
    """

    def __init__(self, parser: Parser) -> None:
        self._parser = parser
        self._options: list[tuple[str, str]] = []

    def take(self, arguments: argparse.Namespace) -> None:
        """Take what was parsed."""
        for name in _CARRIED:
            value = getattr(arguments, name, None)
            values = value if isinstance(value, list) else [] if value is None else [value]
            self._options += [(f"--{name}", str(one)) for one in values]
        for name in _CARRIED_FLAGS:
            if getattr(arguments, name, False):
                self._options.append((f"--{name.replace('_', '-')}", ""))

    def completed(self, found: re.Match[str]) -> str:
        """Return a command with the options that it takes, and that were given."""
        parser, words = self._parser, list[str]()
        for word in found["words"].split():
            inner = parser.command(word)
            if inner is None:
                break
            parser, words = inner, [*words, word]
        missing = [
            shlex.join((option, value) if value else (option,))
            for option, value in self._options
            if parser.takes(option, value) and f"{option} " not in f"{found[0]} "
        ]
        if not words or not missing:
            return found[0]
        begin = f"fieldkit {' '.join(words)}"
        return f"{begin} {' '.join(missing)}{found[0].removeprefix(begin)}"


_known: ContextVar[Given | None] = ContextVar("known", default=None)


@contextmanager
def completing(parser: Parser) -> Iterator[Given]:
    """Complete commands while the body runs, by what is given to the object that this yields."""
    known = Given(parser)
    token = _known.set(known)
    try:
        yield known
    finally:
        _known.reset(token)


def completed(text: str) -> str:
    """Return a text with its commands of fieldkit as they have to be typed here."""
    known = _known.get()
    return text if known is None else _COMMAND.sub(known.completed, text)
