"""Errors in the code of a step kind. The operator gets a message, which names a log file with the traceback."""

import errno
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.errors import ConfigurationError, FieldkitError, RobotError, describe_exception

REPORT: Final = "report it to the author of the step"
SEE_LOG: Final = f"traceback in {laptop_files.STEP_ERROR}"

_DISK_ERRORS: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE})
"""Errors of this machine that another attempt would not avoid."""


class StepError(RobotError):
    """A kind of step raised an exception other than fieldkit's errors. Another attempt would raise it again.

    Args:
        what: Description of the exception in one line.
        traceback_text: Traceback of the exception.
    """

    def __init__(self, what: str, traceback_text: str) -> None:
        super().__init__(what, remedy=REPORT)
        self.traceback_text = traceback_text


class StepErrors:
    """Exceptions that steps raised while the evidence of an attempt was measured."""

    def __init__(self) -> None:
        self.tracebacks: list[str] = []

    def add(self, what: str, error: Exception) -> str:
        """Add an exception and return its description in one line.

        Args:
            what: The failed action, for example `the evidence of the step ping cannot be measured`.
            error: The exception.
        """
        self.tracebacks.append("".join((f"{what}:\n", *traceback.format_exception(error))))
        return f"{what}: {describe_exception(error)}"


@contextmanager
def during_attempt(kind: str) -> Iterator[None]:
    """Run the body, and convert exceptions that a kind of step does not handle.

    Errors of fieldkit, errors of this machine's memory and disk, and interrupts are not converted.

    Args:
        kind: Kind of the outermost step in the body.

    Raises:
        StepError: The body raised another exception.
    """
    try:
        yield
    except (FieldkitError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
            raise
        text = "".join(traceback.format_exception(error))
        raise StepError(f"the step {kind} raised {describe_exception(error)}", text) from error


@contextmanager
def before_trial(what: str) -> Iterator[None]:
    """Run the body, which calls a step before the folder of an attempt exists, and convert exceptions of the step.

    Errors of fieldkit and of this machine's memory are not converted.

    Args:
        what: The failed action, for example `the commands of the step route cannot be derived`.

    Raises:
        ConfigurationError: The body raised another exception. The remedy names a file with the traceback, unless it
            could not be written.
    """
    try:
        yield
    except (FieldkitError, MemoryError):
        raise
    except Exception as error:
        remedy = REPORT
        with suppress(OSError):  # a full disk must not hide the error
            with tempfile.NamedTemporaryFile(
                "w",
                encoding="utf-8",
                errors="backslashreplace",
                prefix="fieldkit-step-error-",
                suffix=".log",
                delete=False,
            ) as log:
                log.writelines(traceback.format_exception(error))
            remedy += f", with its traceback in {log.name}"
        raise ConfigurationError(f"{what}: {describe_exception(error)}", remedy=remedy) from error


def store(tracebacks: Sequence[str], folder: Path) -> None:
    """Append tracebacks, if there are any, to `step-error.log` of an attempt."""
    if tracebacks:
        with log_file(folder).open("a", encoding="utf-8", errors="backslashreplace") as log:
            log.writelines(tracebacks)


def log_file(folder: Path) -> Path:
    """Return the path of the log of exceptions in an attempt's folder."""
    return folder / laptop_files.STEP_ERROR
