"""The command line, one module per subcommand: parse, call one library function, print, return an exit code."""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from fieldkit import __version__
from fieldkit.cli import columns, procedures, rebuild, robots, trial, verify
from fieldkit.cli.display import show_error
from fieldkit.errors import ConfigurationError, FieldkitError

INTERRUPTED: Final = 130

_EPILOG: Final = (
    "exit codes: 0 valid, 1 threshold missed, 2 usage or configuration, 3 robot or link, "
    "4 evidence not valid, 130 interrupted with the state saved"
)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    top = argparse.ArgumentParser(
        prog="fieldkit", description="Field trials of robots whose radio links are under test.", epilog=_EPILOG
    )
    top.add_argument("--version", action="version", version=f"fieldkit {__version__}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in (trial, robots, procedures, columns, rebuild, verify):
        module.add(commands)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    arguments = parser().parse_args(argv)
    try:
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
