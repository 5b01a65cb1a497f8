"""The parser of the command line, which tells a typing error as every other error is told."""

import argparse
import difflib
import re
from typing import Any, Final, NoReturn

from fieldkit.core.errors import ConfigurationError

_CHOICE: Final = re.compile(r"argument (?P<what>.*?): invalid choice: '(?P<typed>.*)' \(choose from (?P<known>.*)\)")

_NEGATIVE: Final = re.compile(r"-\.?\d")


class Parser(argparse.ArgumentParser):
    """An `ArgumentParser` whose errors are `ConfigurationError`s, which takes `-5m` for a length and not for options.

    So are those of its subcommands.
    """

    def __init__(self, *words: Any, **options: Any) -> None:  # noqa: ANN401 (as they come)
        super().__init__(*words, **options)
        # argparse knows negative numbers alone, without a unit, and has no public name for what it takes for one.
        self._negative_number_matcher = _NEGATIVE

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
