"""Move a command to the background once its start-up is complete."""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

OnReady = Callable[[Path], None]
"""Called when start-up is complete, with the log file for all further output."""

_READY: Final = b"+"


def run_detached(work: Callable[[OnReady], int]) -> int:
    """Run `work` in a child process; return when its start-up is complete or it has exited.

    During start-up the child keeps this terminal: its output is shown here, and it receives Ctrl-C.

    Args:
        work: Receives a function that it calls with its log file when start-up is complete; after that call it has no
            terminal. Returns its exit code.

    Returns:
        0 if start-up is complete, the exit code of `work` if it exited before.
    """
    reader, writer = os.pipe()
    sys.stdout.flush()  # otherwise the child would write the buffered text again
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        code = 1
        try:
            code = work(lambda log: _leave(writer, log))
        except BaseException:  # noqa: BLE001 (reported as by the interpreter; the parent does its own clean-up)
            sys.excepthook(*sys.exc_info())
        sys.stdout.flush()
        os._exit(code)
    os.close(writer)
    try:
        with os.fdopen(reader, "rb") as ready:
            if ready.read() == _READY:
                return 0
    except BaseException:
        os.kill(pid, signal.SIGTERM)
        os.waitpid(pid, 0)
        raise
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _leave(writer: int, log: Path) -> None:
    """Detach from the terminal and the current directory, and notify the parent that start-up is complete."""
    sys.stdout.flush()
    os.setsid()
    os.chdir("/")
    null = os.open(os.devnull, os.O_RDONLY)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for source, target in ((null, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    os.close(null)
    os.close(output)
    os.write(writer, _READY)
    os.close(writer)
