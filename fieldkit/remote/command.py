"""Remote command lines. They are argument lists, and only this module quotes them."""

import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Final

from fieldkit.core.text import sanitized

_STYLE: Final = re.compile(r"\x1b\[[0-9;]*m")
"""Escape sequences of colours, which some tools write even to logs."""


def quote(argv: Sequence[str]) -> str:
    """Return `argv` as one string for SSH, quoted for any POSIX login shell and for fish."""
    # In single quotes fish treats a backslash as an escape character; in double quotes all shells agree.
    return " ".join(shlex.quote(word).replace("\\", "'\"\\\\\"'") for word in argv)


def with_environment(
    argv: Sequence[str], *, setup: Sequence[str] = (), environment: Mapping[str, str] | None = None
) -> tuple[str, ...]:
    """Return `argv` with `environment` set and, if there is a `setup`, run by bash after sourcing these files.

    A non-interactive SSH session skips `.bashrc`, where robots usually source their ROS setup files.
    """
    variables = [f"{name}={value}" for name, value in (environment or {}).items()]
    command = ("env", *variables, *argv) if variables else tuple(argv)
    if not setup:
        return command
    source = " && ".join(f". {shlex.quote(path)}" for path in setup)
    return ("bash", "-c", f'{source} && exec "$@"', "bash", *command)


def printable(data: bytes, limit: int = 300) -> str:
    """Return output of a robot as one line that is safe in a terminal, a log and a CSV.

    Of a long output, only the end is returned: at most `limit` characters, from the start of a word.
    """
    words = sanitized(" ".join(_STYLE.sub("", data.decode("utf-8", "replace")).split()))
    if len(words) <= limit:
        return words
    end = words[-limit:]
    return end.partition(" ")[2] or end  # omit the first word, whose start may be missing
