"""Errors in the code of a step kind: the attempt fails with a one-line message, the traceback goes to a file."""

import errno
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.errors import FieldkitError, RobotError

_DISK_ERRORS: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE})
"""Errors of this machine that another attempt would not avoid."""


class StepError(RobotError):
    """A kind of step raised an exception that is not one of fieldkit's errors."""


@contextmanager
def reported(kind: str, folder: Path | None) -> Iterator[None]:
    """Run the body; convert an exception that a kind of step does not handle.

    Errors of fieldkit, of this machine's memory and disk, and interrupts pass through.

    Args:
        kind: The kind of the outermost step in the body.
        folder: The attempt's folder on this machine, for the traceback; None if there is none.

    Raises:
        StepError: The body raised another exception. The message is one line; `step-error.log` has the traceback.
    """
    try:
        yield
    except (FieldkitError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
            raise
        remedy = "report it to the author of the step"
        if folder is not None:
            store(traceback.format_exception(error), folder)
            remedy += f", with {laptop_files.STEP_ERROR} of this repeat"
        first_line = next(iter(str(error).splitlines()), "")
        what = f"the step {kind} raised {type(error).__name__}" + (f": {first_line}" if first_line else "")
        raise StepError(what, remedy=remedy) from error


def store(tracebacks: Sequence[str], folder: Path) -> None:
    """Append tracebacks, if there are any, to `step-error.log` of an attempt."""
    if tracebacks:
        with (folder / laptop_files.STEP_ERROR).open("a", encoding="utf-8", errors="backslashreplace") as log:
            log.writelines(tracebacks)
