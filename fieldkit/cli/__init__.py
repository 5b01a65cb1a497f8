"""The command line: parse, call one library function, print, return an exit code.

`commands` lists every command and imports the module of a command only when the command is used, so help, usage
errors and completion import no library except rich. `parser` adds the commands of other packages.
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
from fieldkit.cli import commands, hints
from fieldkit.cli.parser import Parser, add_plugin_commands, load_plugin
from fieldkit.core.errors import ConfigurationError, FieldkitError

INTERRUPTED: Final = 130

EXIT_CODES: Final[Mapping[int, str]] = MappingProxyType(
    {
        0: "Done; for `trial`: every repeat is valid, and every expectation is met.",
        1: "A threshold or an expectation is not met, a simulator, its check or a worker process failed, `clocks` "
        "found a problem, no configuration of a middleware passed, or the operator skipped a request or answered no.",
        INTERRUPTED: "Interrupted by Ctrl-C or another signal; all finished repeats are saved.",
    }
)
"""Exit codes that do not belong to a subclass of `FieldkitError`."""

_COLLECT_AFTER: Final = 50_000
"""Number of new objects after which the cyclic garbage collector runs.

Imports create fewer objects, so it does not run during imports, when it would free nothing.
"""

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "1")
"""Setting of OpenBLAS, which numpy uses. By default it starts a thread per core, and each waits busily for 30 ms.

The matrices of fieldkit are too small to be processed faster by several threads.
"""

_EPILOG: Final = """\
start with emulated robots:  fieldkit trial los 30ft --repeats 1 --record 1s
start with real robots:      fieldkit init

exit codes: 0 valid, 1 threshold or expectation not met, or request skipped,
2 usage or configuration, 3 robot or link, 4 evidence not valid, 130
interrupted with the state saved"""


def parser() -> Parser:
    """Return the parser of the whole command line."""
    top = Parser(
        prog="fieldkit",
        description="Field trials of robots whose radio links are under test.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"fieldkit {__version__}")
    subparsers = top.add_commands(title="commands", metavar="COMMAND")
    commands.add_all(subparsers)
    top.set_defaults(plugin=None)
    add_plugin_commands(subparsers)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    _open_missing_streams()
    gc.set_threshold(_COLLECT_AFTER)
    os.environ.setdefault(*_ONE_THREAD)
    if "_ARGCOMPLETE" in os.environ:  # a shell requests completions
        from fieldkit.cli.commands import completion  # noqa: PLC0415 (needed only for completion)

        completion.write_completions(parser())
    top = parser()
    with hints.adding_options(top) as options:
        return _run_with_error_messages(top, argv, options)


def _open_missing_streams() -> None:
    """Open standard streams that the caller closed (`>&-`).

    Otherwise a file of a trial could get the free file descriptor, and output of a child process would be written to
    it.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115 (open until exit)


def _run_with_error_messages(top: Parser, argv: Sequence[str] | None, options: hints.CliOptions) -> int:
    """Parse and run the command. Print any error that stops it, and return its exit code."""
    try:
        arguments = top.parse_args(argv)
        arguments.words = tuple(sys.argv[1:] if argv is None else argv)
        options.read(arguments)
        return _run(arguments)
    except FieldkitError as error:
        _show_error(str(error))
        return error.exit_code
    except BrokenPipeError:
        # The program that reads the output has exited, so an error message would not be read.
        _discard_output()
        sys.stderr.close()
        return 0
    except OSError as error:
        # Library functions wrap the errors that they expect. A full disk can make any write fail.
        remedy = "free some space" if error.errno in {errno.ENOSPC, errno.EDQUOT} else "remove the cause"
        location = error.filename or "its output"
        if error.filename is None:
            _discard_output()
        _show_error(
            f"{location}: {error.strerror}\n"
            f"  remedy: {remedy}, then run the command again; finished repeats are saved"
        )
        return ConfigurationError.exit_code
    except MemoryError:
        _show_error("this machine has too little memory\n  remedy: close other programs, or use a larger machine")
        return ConfigurationError.exit_code
    except KeyboardInterrupt:
        _show_error("interrupted; finished repeats are saved")
        return INTERRUPTED


def _discard_output() -> None:
    """Redirect the standard output, which cannot be written, to /dev/null.

    Python writes the rest of the buffer when it exits. That would fail again and change the exit code.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(arguments: argparse.Namespace) -> int:
    """Run the command, or print the help if no command is given."""
    if arguments.run is None:
        arguments.parser.print_help()
        return 0
    run: Callable[[argparse.Namespace], int]
    run = arguments.run if arguments.plugin is None else load_plugin(arguments.plugin, arguments.run)
    return run(arguments)


def _show_error(text: str) -> None:
    from fieldkit.cli.display import show_error  # noqa: PLC0415 (imports rich, which not every command needs)

    show_error(text)
