"""The command line, one module per subcommand: parse, call one library function, print, return an exit code."""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from fieldkit import __version__
from fieldkit.cli import (
    abort,
    aggregate,
    campaign,
    check,
    columns,
    compare,
    enroll,
    export,
    init,
    lab,
    procedures,
    rebuild,
    report,
    resume,
    robots,
    trial,
    verify,
)
from fieldkit.cli.display import show_error
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError, FieldkitError

INTERRUPTED: Final = 130

_EPILOG: Final = """\
begin with emulated robots:  fieldkit trial los 30ft --repeats 1 --record 1s
begin with real ones:        fieldkit init

exit codes: 0 valid, 1 threshold missed or something left open, 2 usage or
configuration, 3 robot or link, 4 evidence not valid, 130 interrupted with the
state saved"""


_COMMANDS: Final = (
    init,
    enroll,
    check,
    trial,
    campaign,
    resume,
    abort,
    lab,
    aggregate,
    compare,
    report,
    export,
    robots,
    procedures,
    columns,
    rebuild,
    verify,
)
"""In the order in which the help lists them."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    top = Parser(
        prog="fieldkit",
        description="Field trials of robots whose radio links are under test.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"fieldkit {__version__}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in _COMMANDS:
        module.add(commands)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    try:
        arguments = parser().parse_args(argv)
        code: int = arguments.run(arguments)
    except FieldkitError as error:
        show_error(str(error))
        return error.exit_code
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output went away: nothing is left to say, nor anyone to say it to
        return 0
    except OSError as error:
        # What a library function could foresee it has explained; a disk that fills up can meet any write.
        show_error(f"{error.filename or 'a write'}: {error.strerror}\n  remedy: mend it; what had ended is saved")
        return ConfigurationError.exit_code
    except KeyboardInterrupt:
        show_error("interrupted; what had ended is saved")
        return INTERRUPTED
    return code
