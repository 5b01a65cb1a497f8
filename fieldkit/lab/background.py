"""Go on in the background, once everything is up."""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

Leave = Callable[[Path], None]
"""To be called when all is up, with a file for what is said from then on."""

_READY: Final = b"+"


def detached(work: Callable[[Leave], int]) -> int:
    """Run `work` in another process, and return when it is up or has ended.

    Until it is up it has this terminal: what it says, and Ctrl-C, are as if it ran here.

    Args:
        work: Gets what to call when it is up, with its log; from then on it has no terminal. Returns its exit code.

    Returns:
        0 when it is up, its exit code when it ended before.
    """
    reader, writer = os.pipe()
    sys.stdout.flush()  # or the other one would write it, too
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        code = 1
        try:
            code = work(lambda log: _leave(writer, log))
        except BaseException:  # noqa: BLE001 (told, as the interpreter tells it; the caller's clean-up is not ours to run)
            sys.excepthook(*sys.exc_info())
        sys.stdout.flush()
        os._exit(code)
    os.close(writer)
    try:
        with os.fdopen(reader, "rb") as up:
            if up.read() == _READY:
                return 0
    except BaseException:
        os.kill(pid, signal.SIGTERM)
        os.waitpid(pid, 0)
        raise
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _leave(writer: int, log: Path) -> None:
    """Let go of the terminal and of the caller's directory, and say that all is up."""
    sys.stdout.flush()
    os.setsid()
    os.chdir("/")
    nothing = os.open(os.devnull, os.O_RDONLY)
    said = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for source, target in ((nothing, 0), (said, 1), (said, 2)):
        os.dup2(source, target)
    os.close(nothing)
    os.close(said)
    os.write(writer, _READY)
    os.close(writer)
