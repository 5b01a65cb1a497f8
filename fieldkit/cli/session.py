"""What the subcommands that work with robots share: the site file, the backend, the operator."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TextIO

from fieldkit.backends.protocols import Backend
from fieldkit.backends.registry import backend_names, load_backend
from fieldkit.cli.terminal import Terminal
from fieldkit.config import profiles
from fieldkit.config.profiles import Site
from fieldkit.config.schema import Document
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Note, Sink
from fieldkit.core.prompts import Nobody, Operator, Script

DEFAULT_BACKEND: Final = "emulated"
_STANDARD_INPUT: Final = "-"


def add_site(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which robots."""
    parser.add_argument(
        "--backend",
        metavar="NAME",
        help=f"one of: {', '.join(backend_names())} (default: the site file's; without one, emulated)",
    )
    parser.add_argument(
        "--site",
        type=Path,
        metavar="FILE",
        help=f"site file of the lab (default: {profiles.SITE_FILE}, if there is one)",
    )


def add_operator(parser: argparse.ArgumentParser) -> None:
    """Add the options that say who is asked."""
    answers = parser.add_mutually_exclusive_group()
    answers.add_argument("--yes", action="store_true", help="do not ask: the robots stand where they should")
    answers.add_argument(
        "--answers", metavar="FILE", help=f"answers, a line per request; {_STANDARD_INPUT}: from standard input"
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the option for programs that read along."""
    parser.add_argument("--json", action="store_true", help="one event a line instead of the display")


@contextmanager
def operator(arguments: argparse.Namespace, sink: Sink) -> Iterator[Operator]:
    """Yield who is asked: nobody, lines of a file or of a pipe, or the person at the terminal.

    Raises:
        ConfigurationError: The answers cannot be read.
    """
    if arguments.yes:
        yield Nobody()
    elif arguments.answers is None:
        yield Terminal(sink)
    elif arguments.answers == _STANDARD_INPUT:
        yield Script(sys.stdin, "standard input", sink)
    else:
        with _opened(arguments.answers) as file:
            yield Script(file, arguments.answers, sink)


def _opened(path: str) -> TextIO:
    try:
        return Path(path).open(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ConfigurationError(
            f"the answers cannot be read: {error.strerror}", where=path, remedy="correct --answers"
        ) from error


def backend(arguments: argparse.Namespace, sink: Sink) -> tuple[str, Backend]:
    """Return the name of the backend that the options and the site file choose, and the backend.

    Raises:
        ConfigurationError: As `load_site` and `load_backend`.
    """
    site, document = lab_site(arguments)
    if site is None:
        name = arguments.backend or DEFAULT_BACKEND
        if arguments.backend is None:
            sink(Note(f"no site file {profiles.SITE_FILE} here: using emulated robots"))
        return name, load_backend(name, None, None)
    name = arguments.backend or site.backend
    return name, load_backend(name, site, document)


def lab_site(arguments: argparse.Namespace) -> tuple[Site, Document] | tuple[None, None]:
    """Return the site file that the options choose, with its document; none where there is none.

    Raises:
        ConfigurationError: As `load_site`.
    """
    path: Path | None = arguments.site
    if path is None and Path(profiles.SITE_FILE).is_file():
        path = Path(profiles.SITE_FILE)
    return (None, None) if path is None else profiles.load_site(path)
