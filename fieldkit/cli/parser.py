"""The parser of the command line, which tells a typing error as every other error is told."""

import argparse
import difflib
import re
from typing import Final, NoReturn

from fieldkit.errors import ConfigurationError

_CHOICE: Final = re.compile(r"argument (?P<what>.*?): invalid choice: '(?P<typed>.*)' \(choose from (?P<known>.*)\)")


class Parser(argparse.ArgumentParser):
    """An `ArgumentParser` whose errors are `ConfigurationError`s; so are those of its subcommands."""

    def error(self, message: str) -> NoReturn:
        """Raise what was typed wrong, with what was perhaps meant.

        Raises:
            ConfigurationError: Always.
        """
        remedy = f"{self.prog} --help"
        if choice := _CHOICE.fullmatch(message):
            known = re.findall(r"[\w-]+", choice["known"])
            message = f"{choice['what']} cannot be {choice['typed']!r}; it is one of: {', '.join(known)}"
            near = difflib.get_close_matches(choice["typed"], known, n=1)
            remedy = f"did you mean {near[0]!r}?" if near else remedy
        raise ConfigurationError(message, remedy=remedy)
