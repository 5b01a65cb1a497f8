"""The command line: parse, call one library function, print, return an exit code.

`commands` lists every command, and imports its module when it is named: help, typing errors and completion need no
library but rich. `outside` adds the commands of other packages.
"""

import argparse
import errno
import gc
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

from fieldkit import __version__
from fieldkit.cli import commands, hints, outside
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError, FieldkitError

INTERRUPTED: Final = 130

EXIT_CODES: Final[Mapping[int, str]] = MappingProxyType(
    {
        0: "Done; for `trial`: every repeat ended valid.",
        1: "A threshold was missed, an expectation was not shown to hold, or something was left open because the "
        "operator skipped it.",
        INTERRUPTED: "Interrupted by Ctrl-C; everything that had ended is saved.",
    }
)
"""Exit codes that are not those of a family of errors."""

_COLLECT_AFTER: Final = 50_000
"""How many new objects the collector of cycles lets pass: imports make fewer, of which it would free none."""

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "1")
"""numpy's OpenBLAS starts a thread per core, which spins for 30 ms, for products of larger matrices than any here."""

_EPILOG: Final = """\
begin with emulated robots:  fieldkit trial los 30ft --repeats 1 --record 1s
begin with real ones:        fieldkit init

exit codes: 0 valid, 1 threshold missed or something left open, 2 usage or
configuration, 3 robot or link, 4 evidence not valid, 130 interrupted with the
state saved"""


def parser() -> Parser:
    """Return the parser of the whole command line."""
    top = Parser(
        prog="fieldkit",
        description="Field trials of robots whose radio links are under test.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"fieldkit {__version__}")
    found = top.add_commands(title="commands", metavar="COMMAND")
    commands.add_all(found)
    top.set_defaults(outside=None)
    outside.add_all(found)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    _fill_streams()
    gc.set_threshold(_COLLECT_AFTER)
    os.environ.setdefault(*_ONE_THREAD)
    if "_ARGCOMPLETE" in os.environ:  # a shell asks how its line may go on
        from fieldkit.cli.commands import completion  # noqa: PLC0415 (only then)

        completion.answer(parser())
    top = parser()
    with hints.completing(top) as known:
        return _guarded(top, argv, known)


def _fill_streams() -> None:
    """Open what the caller closed (`>&-`): a file of a trial would take its number, and a child print into it."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115 (until the end)


def _guarded(top: Parser, argv: Sequence[str] | None, known: hints.Given) -> int:
    """Parse and run the command; whatever ends it early is told, and is an exit code."""
    try:
        arguments = top.parse_args(argv)
        known.take(arguments)
        return _run(arguments)
    except FieldkitError as error:
        _show_error(str(error))
        return error.exit_code
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output went away: nothing is left to say, nor anyone to say it to
        return 0
    except OSError as error:
        # What a library function could foresee it has explained; a disk that fills up can meet any write.
        first = "free some space" if error.errno in {errno.ENOSPC, errno.EDQUOT} else "mend it"
        where = error.filename or "its output"
        _show_error(f"{where}: {error.strerror}\n  remedy: {first}, then type it again; what had ended is saved")
        return ConfigurationError.exit_code
    except MemoryError:
        _show_error(
            "this machine has too little memory for it\n  remedy: end other programs, or do it on a larger one"
        )
        return ConfigurationError.exit_code
    except KeyboardInterrupt:
        _show_error("interrupted; what had ended is saved")
        return INTERRUPTED


def _run(arguments: argparse.Namespace) -> int:
    """Run the command; without one, print the help."""
    if arguments.run is None:
        arguments.parser.print_help()
        return 0
    run: Callable[[argparse.Namespace], int]
    run = arguments.run if arguments.outside is None else outside.load(arguments.outside, arguments.run)
    return run(arguments)


def _show_error(text: str) -> None:
    from fieldkit.cli.display import show_error  # noqa: PLC0415 (rich, which most commands that go well need, too)

    show_error(text)
