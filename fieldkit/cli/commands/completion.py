"""Complete command lines in bash, zsh and fish. Only this module imports argcomplete.

Argcomplete runs fieldkit at each press of the Tab key. Therefore this module does not import the code that validates
files, which would take long.
"""

import argparse
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Final

import argcomplete
from argcomplete.completers import BaseCompleter, FilesCompleter
from argcomplete.shell_integration import shellcode

from fieldkit.cli.parser import Parser
from fieldkit.config import locations
from fieldkit.core import plugins
from fieldkit.core.errors import FieldkitError

SHELLS: Final = ("bash", "zsh", "fish")


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit completion`."""
    parser.description = (
        "Print a script with which the Tab key completes commands, options, robots, procedures, backends and trial "
        "folders. In zsh, run compinit first."
    )
    parser.epilog = (
        'in ~/.bashrc or ~/.zshrc: eval "$(fieldkit completion bash)", or zsh; '
        "in ~/.config/fish/config.fish: fieldkit completion fish | source"
    )
    parser.add_choice("shell", SHELLS, metavar="SHELL", help=f"one of: {', '.join(SHELLS)}")
    parser.set_defaults(run=run)


PLAN_FILE: Final = "trial.yaml"
"""Equal to `trial.plan.PLAN_FILE`; a test compares them."""

_TRIALS: Final = "trials"


def run(arguments: argparse.Namespace) -> int:
    """Print the script that a shell evaluates."""
    print(shellcode(["fieldkit"], use_defaults=False, shell=arguments.shell), end="")
    return 0


def write_completions(parser: Parser) -> None:
    """Write the completions of the shell's command line, and exit."""
    _declare_command(parser)
    argcomplete.autocomplete(parser, always_complete_options=False, default_completer=_Values())


def _declare_command(parser: Parser) -> None:
    """Declare the arguments of the command in the shell's line before argcomplete parses the line."""
    words = os.environ["COMP_LINE"].split()
    command = parser.command(words[1]) if len(words) > 1 else None
    if command is not None:
        with suppress(FieldkitError):  # running the command reports the error of its package
            command.declare_arguments()


class _Values(BaseCompleter):
    """Completes the value of an argument by the argument's name in argparse's namespace.

    Arguments with free text are not completed.
    """

    def __call__(
        self, *, prefix: str, action: argparse.Action, parser: argparse.ArgumentParser, **_: object
    ) -> list[str]:
        """Return possible values; argcomplete drops those that do not start with `prefix`."""
        if action.dest == "robot" and parser.prog.startswith("fieldkit lab "):
            return _robots_of_lab()
        values = _VALUES.get(action.dest)
        return list(values(prefix)) if values else []


def _robots_of_site() -> list[str]:
    from fieldkit.config import documents

    try:
        robots = documents.read(Path(locations.SITE_FILE)).data["robots"]
    except (FieldkitError, KeyError, TypeError):
        return []  # running the command reports the error of the file
    return list(robots) if isinstance(robots, dict) else []


def _robots_of_lab() -> list[str]:
    from fieldkit.lab import folder

    try:
        hosts = folder.of_directory(Path.cwd()).known_hosts.read_text(encoding="utf-8")
    except (FieldkitError, OSError):
        return []  # no lab is up
    return [line.split()[0] for line in hosts.splitlines()]


def _trials(prefix: str) -> Iterator[str]:
    """Yield the trials and other folders in the folder of `prefix`; without a prefix also those in `trials`.

    Argcomplete drops the paths that do not start with `prefix`.
    """
    folder = os.path.dirname(prefix)  # noqa: PTH120 (a Path drops `./` and a trailing slash)
    for parent in (folder,) if prefix else ("", _TRIALS):
        try:
            with os.scandir(parent or ".") as scan:
                entries = sorted(scan, key=lambda entry: entry.name)
        except OSError:
            continue
        for entry in entries:
            if entry.is_dir() and not entry.name.startswith("."):
                path = os.path.join(parent, entry.name)  # noqa: PTH118 (as above)
                yield path if os.path.exists(f"{path}/{PLAN_FILE}") else f"{path}/"  # noqa: PTH110 (as above)


def _tables(prefix: str) -> Iterator[str]:
    """Yield trials and CSV files."""
    yield from _trials(prefix)
    yield from (path for path in _FILES(prefix) if path.endswith(".csv"))


def _backends(_prefix: str) -> Iterable[str]:
    return (point.name for point in plugins.entry_points(plugins.BACKENDS))


def _quantities(_prefix: str) -> Iterable[str]:
    from fieldkit.trial.columns import installed_columns

    return (column.name for column in installed_columns() if column.figure)


def _columns(_prefix: str) -> Iterable[str]:
    from fieldkit.trial.columns import installed_columns

    return (column.name for column in installed_columns())


_FILES: Final = FilesCompleter()
_VALUES: Final[Mapping[str, Callable[[str], Iterable[str]]]] = MappingProxyType(
    {
        "procedure": lambda _: locations.names("procedures"),
        "profile": lambda _: locations.names("robots"),
        "robot": lambda _: _robots_of_site(),
        "trial": _trials,
        "paths": _tables,
        "a": _tables,
        "b": _tables,
        "backend": _backends,
        "quantity": _quantities,
        "procedure_or_show": lambda _: ("show", *locations.names("procedures")),
        "column": _columns,
        **dict.fromkeys(("site", "out", "answers", "file", "figures"), _FILES),
    }
)
